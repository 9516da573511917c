"""What a user can mend: reported as one line, without a traceback."""


class InputError(ValueError):
    """Input from outside (file, folder, option) that cannot be used.

    The message is one line: what is wrong, where, and what to do about it. The `__main__` files
    print it after `error:` and exit with status 1; anything else that is raised is a bug and keeps
    its traceback.
    """
