"""Preparations that are killed, two that are started at once, a disk that is full: real processes,
real files. `python -m pytest -m slow tests/data_prep/test_killed_preparations.py`
"""

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from captures import write_capture

from extrap_train.store.atomic import partial_path

pytestmark = pytest.mark.slow  # starting a dozen processes takes more than what they do

SEQUENCES, FRAMES = 8, 12
_PAGE_BYTES = os.sysconf("SC_PAGESIZE")
START_SECONDS = 900
"""More than two workers take to their first result, on a busy machine, too."""


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("co3d")
    write_capture(root, tuple(f"s{i}" for i in range(SEQUENCES)), FRAMES)
    return root


def command(photographs: Path, output: Path, workers: int) -> list[str]:
    options = ["category=cup", "data=co3d", f"data.root={photographs}", f"output={output}"]
    # Never corrected, so that starting is most of what it costs.
    fast = ["prep.image_size=128", "data.test_sequences=1", "prep.correct=false"]
    return [sys.executable, "-m", "data_prep", *options, *fast, f"workers={workers}"]


def start(photographs: Path, output: Path, workers: int = 2) -> "subprocess.Popen[str]":
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    return subprocess.Popen(command(photographs, output, workers), text=True, **pipes)


def finish(run: "subprocess.Popen[str]") -> str:
    said, _ = run.communicate(timeout=900)
    assert run.returncode == 0, said
    return said


def wait_until(condition: Callable[[], bool], run: "subprocess.Popen[str]") -> None:
    deadline = time.monotonic() + START_SECONDS
    while not condition():
        assert run.poll() is None, run.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.005)


def finished(output: Path) -> list[Path]:
    return list(output.glob("pairs/cup-*/*_pairs/cup/s*/pairs.parquet"))


def contents(output: Path) -> dict[str, bytes]:
    """Every file but the locks, which are empty."""
    return {
        str(file.relative_to(output)): file.read_bytes()
        for file in output.rglob("*")
        if file.is_file() and file.suffix != ".lock"
    }


def workers_of(run: "subprocess.Popen[str]") -> list[int]:
    """The children of the run's fork server."""
    (server,) = (
        p for p in children(run.pid) if b"forkserver" in Path(f"/proc/{p}/cmdline").read_bytes()
    )
    return children(server)


def children(process: int) -> list[int]:
    return [*map(int, Path(f"/proc/{process}/task/{process}/children").read_text().split())]


@pytest.fixture(scope="module")
def undisturbed(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    output = tmp_path_factory.mktemp("undisturbed")
    finish(start(photographs, output, workers=1))
    return contents(output)


def test_a_killed_run_goes_on_and_ends_with_the_same_bytes(
    photographs: Path, undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    run = start(photographs, tmp_path)
    wait_until(lambda: bool(finished(tmp_path)), run)
    run.send_signal(signal.SIGKILL)
    run.communicate()
    done = {file: file.stat().st_mtime_ns for file in finished(tmp_path)}
    assert 0 < len(done) < SEQUENCES, "killed in the middle"
    frames = next(tmp_path.glob("frames/cup-*/frames/cup"))
    # As if it had been killed between two files of a sequence, too.
    half = partial_path(frames / "s7")
    half = half.with_name(half.name.replace(f"-{os.getpid()}.", f"-{run.pid}."))
    half.mkdir()
    (half / "frames.npy").write_bytes(b"half of")
    finish(start(photographs, tmp_path))
    assert contents(tmp_path) == undisturbed
    assert {file: file.stat().st_mtime_ns for file in done} == done


def test_a_killed_worker_costs_nothing_but_time(
    photographs: Path, undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    run = start(photographs, tmp_path)
    wait_until(lambda: bool(finished(tmp_path)), run)
    os.kill(workers_of(run)[0], signal.SIGKILL)
    done = {file: file.stat().st_mtime_ns for file in finished(tmp_path)}
    assert 0 < len(done) < SEQUENCES, "killed in the middle"
    finish(run)
    assert contents(tmp_path) == undisturbed
    assert {file: file.stat().st_mtime_ns for file in done} == done


def test_a_second_run_on_the_same_folder_finds_everything_done(
    photographs: Path, undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    first = start(photographs, tmp_path)
    wait_until(lambda: bool(list(tmp_path.glob("data/.cup.lock"))), first)
    second = start(photographs, tmp_path)  # waits, unless the first has ended before it asks
    finish(first)
    made = {file: file.stat().st_mtime_ns for file in finished(tmp_path)}
    finish(second)
    assert {file: file.stat().st_mtime_ns for file in finished(tmp_path)} == made
    assert contents(tmp_path) == undisturbed


def test_a_full_disk_is_one_line_and_the_same_command_goes_on(
    photographs: Path, undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    """A file system in memory, which this process and its children alone can see, with half of the
    pages that the sequences need.
    """
    sequences = [x for name, x in undisturbed.items() if name.startswith(("frames/", "pairs/"))]
    pages = sum(-(-len(content) // _PAGE_BYTES) for content in sequences)
    small, whole = f"size={pages // 2 * _PAGE_BYTES},mode=755", "remount,size=64m"
    if subprocess.run(["unshare", "-rm", "mount", "-t", "tmpfs", "x", str(tmp_path)]).returncode:
        pytest.skip("this machine lets nobody mount a file system of their own")
    output = tmp_path / "disk"
    output.mkdir()
    prepare = shlex.join(command(photographs, output, workers=1))
    script = f"""
        mount -t tmpfs -o {small} small {output} && {prepare} > {tmp_path}/first 2>&1 && exit 9
        find {output} -name pairs.parquet | sort > {tmp_path}/kept
        mount -o {whole} {output} && {prepare}
        cp -r {output} {tmp_path}/made
    """
    subprocess.run(["unshare", "-rm", "sh", "-c", script], check=True)
    last = (tmp_path / "first").read_text().strip().splitlines()[-1]
    assert "no space left on the device" in last
    assert "finished sequences are kept" in last
    assert "Traceback" not in (tmp_path / "first").read_text()
    assert 0 < len((tmp_path / "kept").read_text().split()) < SEQUENCES
    assert contents(tmp_path / "made") == undisturbed
