"""A job's end is a result or a reason, and nothing of it stays."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from extrap_train.jobs import Died
from extrap_train.jobs.isolated import IsolatedLauncher
from extrap_train.jobs.local import LocalLauncher
from tests.jobs.test_launchers import _is_alive, linger

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="adopts orphans")


def _raise() -> None:
    raise OSError("no luck")


def _kill_parent() -> None:
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(600)


def _leave_orphan() -> None:
    """It writes its number into the folder that `act` has gone to."""
    script = "sleep 600 & echo > $!.pid"
    subprocess.run(["sh", "-c", script], start_new_session=True, check=True)


ACTS: dict[str, Callable[[], object]] = {
    "exit": lambda: os._exit(3),
    "raise": _raise,
    "segfault": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "kill": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "kill_parent": _kill_parent,
    "interrupt_parent": lambda: os.kill(os.getppid(), signal.SIGINT),
    "hang": lambda: time.sleep(600),
    "orphan": _leave_orphan,
    "fork": os.fork,
    "state": lambda: os.environ.update(STATE="changed"),
    "fine": lambda: None,
    "nothing": lambda: None,
}


def act(item: tuple[str, str]) -> bytes:
    """What is asked; the state that it found before."""
    what, folder = item
    found = f"{what} {os.environ.get('STATE')} {Path.cwd()}"
    os.chdir(folder)
    ACTS[what]()
    return b"" if what == "nothing" else found.encode()


def _run(tmp_path: Path, *words: str, timeout_s: float = 300.0) -> dict[str, bytes | Died]:
    items = [(word, str(tmp_path)) for word in words]
    done = dict(IsolatedLauncher(2, timeout_s).run(act, items))
    assert sorted(done) == [*range(len(words))]
    return {word: done[index] for index, word in enumerate(words)}


def test_every_end_is_a_result_or_a_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE", "as it was")
    sound = ("state", "fork", "orphan", "interrupt_parent", "fine")
    reasons = {
        "exit": "exit status 3",
        "nothing": "exit status 0",
        "raise": "exit status 1",
        "segfault": "SIGSEGV",
        "kill": "killed",
        "kill_parent": "killed",
    }
    done = _run(tmp_path, *reasons, *sound)
    for word, said in reasons.items():
        result = done[word]
        assert isinstance(result, Died), word
        assert said in result.reason
    for word in sound:
        assert done[word] == f"{word} as it was {Path.cwd()}".encode()
    (orphan,) = tmp_path.glob("*.pid")
    assert not _is_alive(int(orphan.stem))


def count_running(folder: str) -> bytes:
    """How many run, this one included, when it begins; it takes longer than a look at them."""
    own = Path(folder) / f"{os.getpid()}.running"
    own.touch()
    found = len([*own.parent.glob("*.running")])
    time.sleep(1.3)
    own.unlink()
    return str(found).encode()


@pytest.mark.parametrize("workers", [1, 2])
def test_no_more_jobs_run_than_workers(tmp_path: Path, workers: int) -> None:
    launcher = IsolatedLauncher(workers, timeout_s=300.0)
    found = [result for _, result in launcher.run(count_running, [str(tmp_path)] * (workers + 1))]
    assert len(found) == workers + 1
    assert max(found) <= str(workers).encode()


def test_what_hangs_is_ended(tmp_path: Path) -> None:
    result = _run(tmp_path, "hang", timeout_s=1.0)["hang"]
    assert isinstance(result, Died)
    assert "longer than 1 s" in result.reason


def test_an_interrupted_launcher_waits_for_no_worker(tmp_path: Path) -> None:
    """They would linger for a minute."""

    def interrupted() -> None:
        with LocalLauncher(2) as local:
            jobs = local.run(linger, [str(tmp_path)] * 2)
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("extrap_train.jobs.local.wait", _interrupt_after(tmp_path))
                next(jobs)

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    ends = time.monotonic() + 20
    while any(_is_alive(int(path.stem)) for path in tmp_path.glob("*.pid")):
        assert time.monotonic() < ends
        time.sleep(0.02)


def _interrupt_after(folder: Path) -> object:
    def wait(*_: object, **__: object) -> None:
        while len([*folder.glob("*.pid")]) < 2:
            time.sleep(0.02)
        raise KeyboardInterrupt

    return wait
