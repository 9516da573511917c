"""Every command ends with a status that says how, and with at most one line."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from torch._utils import ExceptionWrapper

from extrap_train.errors import InputError, ends_in_one_line


def _raise(error: BaseException) -> None:
    raise error


def _taken_for_an_error(number: signal.Signals) -> None:
    try:
        os.kill(os.getpid(), number)
    except KeyboardInterrupt:
        raise ImportError("a library stopped within its import") from None


def _terminated_with_advice() -> None:
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("kept step 3") from None


def _raised_by_a_loader() -> None:
    try:
        _raise(InputError("frames.npy: is damaged"))
    except InputError:
        wrapped = ExceptionWrapper(where="in DataLoader worker process 0")
    wrapped.reraise()


@pytest.mark.parametrize(
    ("end", "status", "line"),
    [
        (lambda: _raise(InputError("no such folder")), 1, "error: no such folder"),
        (_raised_by_a_loader, 1, "error: frames.npy: is damaged"),
        (lambda: _raise(KeyboardInterrupt()), 130, "interrupted: run the same command again"),
        (lambda: _raise(KeyboardInterrupt("kept step 3")), 130, "interrupted: kept step 3"),
        (lambda: os.kill(os.getpid(), signal.SIGINT), 130, "interrupted: "),
        (lambda: os.kill(os.getpid(), signal.SIGTERM), 143, "terminated: run the same command"),
        (lambda: _taken_for_an_error(signal.SIGINT), 130, "interrupted: "),
        (lambda: _taken_for_an_error(signal.SIGTERM), 143, "terminated: "),
        (_terminated_with_advice, 143, "terminated: kept step 3"),
    ],
)
def test_an_end_has_a_status_and_one_line(
    end: Callable[[], None], status: int, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped, ends_in_one_line():
        end()
    said = capsys.readouterr().err
    assert stopped.value.code == status
    assert said.startswith(line)
    assert said.count("\n") == 1
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL, "as it was before"


def test_an_interrupted_module_ends_with_its_status_in_code_of_a_string_too(tmp_path: Path) -> None:
    (tmp_path / "stopped.py").write_text(
        "import os, signal\n"
        "from extrap_train.errors import ends_in_one_line\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "with ends_in_one_line():\n"
        "    exec('os.kill(os.getpid(), signal.SIGINT)')\n"
    )
    place = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[1])])
    command = [sys.executable, "-m", "stopped"]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": place}, capture_output=True)
    assert done.returncode == 130
    assert done.stderr.startswith(b"interrupted: ")


def test_a_bug_keeps_its_traceback() -> None:
    for bug in (ValueError("x"), OSError(28, "full"), BrokenPipeError(32, "a worker's")):
        with pytest.raises(type(bug)), ends_in_one_line():
            raise bug


_PRINTS = """
from extrap_train.errors import ends_in_one_line
with ends_in_one_line():
    for _ in range({count}):
        print("a line of sixty characters that a reader may not want to see")
"""


@pytest.mark.parametrize(
    ("redirection", "count", "status", "said"),
    [
        ("| head -1 > /dev/null", 20_000, 141, ""),
        ("2>&1 | head -1 > /dev/null", 20_000, 141, ""),
        (">&-", 20_000, 0, ""),
        (">/dev/full", 3, 1, "error: standard output: No space left on device"),
    ],
)
def test_output_that_nobody_takes_is_no_traceback(
    redirection: str, count: int, status: int, said: str
) -> None:
    line = f'"{sys.executable}" -c "$CODE" {redirection}; exit ${{PIPESTATUS[0]}}'
    environment = {**os.environ, "PYTHONUNBUFFERED": "", "CODE": _PRINTS.format(count=count)}
    done = subprocess.run(
        ["bash", "-c", line], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == status
    assert done.stderr.startswith(said)
    assert done.stderr.count("\n") == bool(said)
