"""Every launcher gives every result once, survives a job that kills its process, and stops at an
exception.
"""

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from extrap_train.config import SlurmConfig
from extrap_train.errors import InputError
from extrap_train.jobs import ONE_THREAD, Died, Launcher, available_cores
from extrap_train.jobs.launchers import open_launcher
from extrap_train.jobs.local import LocalLauncher
from extrap_train.jobs.slurm import SubmittedLauncher, slurm_launcher


def test_cores_are_counted_where_the_system_binds_no_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(os, "sched_getaffinity")
    assert available_cores() == os.cpu_count()


def square(number: int) -> int:
    return number * number


def square_or_die(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def square_or_fill_the_disk(number: int) -> int:
    if number == 1:
        raise OSError(errno.ENOSPC, "no space")
    return number * number


def square_or_fill_the_memory(item: tuple[int, str]) -> int:
    number, folder = item
    before = len(list(Path(folder).glob(f"{number}-*")))
    (Path(folder) / f"{number}-{before}").touch()
    if number == 2 or (number == 1 and not before):
        raise MemoryError("too large")
    return number * number


def submitted(folder: Path, tasks: int) -> SubmittedLauncher:
    import submitit

    return SubmittedLauncher(lambda: submitit.LocalExecutor(folder), tasks, poll_seconds=0.05)


@pytest.fixture(autouse=True)
def _jobs_are_found_by_other_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    here = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", f"{here}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")


@pytest.fixture(params=["here", "processes", "submitted"])
def launcher(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Launcher]:
    if request.param == "submitted":
        yield submitted(tmp_path, 3)
        return
    with LocalLauncher(1 if request.param == "here" else 2) as local:
        yield local


def test_every_item_has_its_result_once(launcher: Launcher) -> None:
    done = list(launcher.run(square, range(7)))
    assert sorted(done) == [(i, i * i) for i in range(7)]
    assert list(launcher.run(square, [])) == []


def test_an_exception_ends_everything_and_keeps_its_kind(launcher: Launcher) -> None:
    with pytest.raises(OSError, match="no space") as caught:
        list(launcher.run(square_or_fill_the_disk, range(4)))
    assert caught.value.errno == errno.ENOSPC


@pytest.mark.parametrize(
    "kind",
    # submitit waits a quarter of a minute for the result of a process that was killed.
    ["processes", pytest.param("submitted", marks=pytest.mark.slow)],
)
def test_a_job_that_takes_its_process_along_harms_no_other(kind: str, tmp_path: Path) -> None:
    with LocalLauncher(2) as processes:
        launcher = processes if kind == "processes" else submitted(tmp_path, 2)
        done = dict(launcher.run(square_or_die, range(6)))
    assert isinstance(done.pop(3), Died)
    assert done == {i: i * i for i in range(6) if i != 3}


def test_a_job_without_memory_is_tried_once_more_alone(launcher: Launcher, tmp_path: Path) -> None:
    """As if two at once had filled the memory (1), and as if one were too large for it (2)."""
    tried = tmp_path / "tried"
    tried.mkdir()
    done = dict(launcher.run(square_or_fill_the_memory, [(i, str(tried)) for i in range(4)]))
    assert done == {0: 0, 1: 1, 2: Died("out of memory (too large)"), 3: 9}
    count = {i: len(list(tried.glob(f"{i}-*"))) for i in range(4)}
    assert count == {0: 1, 1: 2, 2: 2, 3: 1}


def test_a_cluster_is_asked_for_with_the_first_jobs_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with open_launcher(SlurmConfig(), 1, tmp_path / "slurm") as launcher:
        assert not (tmp_path / "slurm").exists()
        with pytest.raises(InputError, match="no sbatch on this machine"):
            list(launcher.run(square, [1]))


def test_workers_of_one_thread_do_not_outlive_a_killed_parent(tmp_path: Path) -> None:
    """Their job stands in the script that starts them."""
    program = (
        "from test_launchers import linger\n"
        "from extrap_train.jobs.local import LocalLauncher\n"
        "def job(folder):\n"
        "    linger(folder)\n"
        "if __name__ == '__main__':\n"
        "    with LocalLauncher(2) as local:\n"
        f"        list(local.run(job, [{str(tmp_path)!r}] * 2))\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(program)
    environment = {name: value for name, value in os.environ.items() if name not in ONE_THREAD}
    parent = subprocess.Popen([sys.executable, str(script)], env=environment)
    while len(list(tmp_path.glob("*.pid"))) < 2:
        assert parent.poll() is None
        time.sleep(0.02)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    lingering = list(tmp_path.glob("*.pid"))
    assert {path.read_text() for path in lingering} == {"2"}  # one waits for the parent's end
    deadline = time.monotonic() + 10
    while any(_is_alive(int(path.stem)) for path in lingering):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def linger(folder: str) -> None:
    """Say how many threads there are, then wait."""
    np.ones((500, 500)) @ np.ones((500, 500))
    said = Path(folder) / f"{os.getpid()}.part"
    said.write_text(str(len(list(Path("/proc/self/task").iterdir()))))
    said.rename(said.with_suffix(".pid"))
    time.sleep(60)


def _is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_cluster_that_takes_no_jobs_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusing = tmp_path / "sbatch"
    refusing.write_text("#!/bin/sh\necho 'sbatch: error:\ninvalid partition' >&2\nexit 1\n")
    refusing.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr("shutil.which", lambda name: str(refusing))
    launcher = slurm_launcher(SlurmConfig(), tmp_path / "slurm")
    with pytest.raises(InputError, match=r"takes no jobs \(.*invalid partition.*\); check") as said:
        list(launcher.run(square, [1, 2]))
    assert "\n" not in str(said.value)


def test_a_machine_without_slurm_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match=r"no sbatch on this machine; .*launcher=local"):
        list(slurm_launcher(SlurmConfig(), tmp_path).run(square, [1]))
