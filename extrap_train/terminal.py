"""What commands say."""

from rich.console import Console


def terminal(*, stderr: bool = False, quiet: bool = False) -> Console:
    """A console that says text as it is: what stands in brackets is no markup, nothing between
    colons a picture, and a line is not folded, so that a path can be taken from it.
    """
    return Console(stderr=stderr, quiet=quiet, markup=False, emoji=False, soft_wrap=True)
