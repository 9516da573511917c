"""Commands in the process of the test: another one would load for longer than they run."""

import io
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from extrap_train.__main__ import main


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


def refused_command(arguments: list[str], folder: Path) -> str:
    """What `python -m extrap_train` says before it gives up; it must be one line and leave no run
    in `folder`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["extrap_train", *arguments, f"output={folder / 'out'}"])
        with pytest.raises(SystemExit) as stopped:
            main()
    message = str(stopped.value)
    assert message.startswith("error: ")
    assert "\n" not in message
    assert not (folder / "out" / "train").exists()
    return message
