"""Commands in the process of the test: another one would load for longer than they run."""

import io
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout

import pytest


def run_command(main: Callable[[], object], *words: str, status: int = 0) -> str:
    """What the command line says on both streams; it must end with `status`."""
    ended: int | str | None = 0
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said), redirect_stderr(said):
        patch.setattr(sys, "argv", ["it", *words])
        try:
            main()
        except SystemExit as end:
            ended = end.code
    assert ended == status, said.getvalue()
    return said.getvalue()
