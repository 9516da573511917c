"""What a user can mend: reported as one line, without a traceback."""

import difflib
from collections.abc import Collection


class InputError(ValueError):
    """Input from outside (file, folder, option) that cannot be used.

    The message is one line: what is wrong, where, and what to do about it. The `__main__` files
    print it after `error:` and exit with status 1; anything else that is raised is a bug and keeps
    its traceback.
    """


def did_you_mean(name: str, known: Collection[str]) -> str:
    """`did you mean a, b?` with the names that look like `name`, or the first few known ones."""
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    return f"did you mean {', '.join(near)}?" if near else f"known: {', '.join(sorted(known)[:8])}"
