"""Kills, signals and full disks at seeded moments: what is left in the end is what an undisturbed
command leaves, bit for bit, and nothing else.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd
import pytest
from tiny_job import TINY

from tests.benchmarks.tables import write_own

_TRAINED = [
    *TINY,
    "trainer.steps=12",
    "trainer.checkpoint_every=3",
    "trainer.validate_every=6",
    "validation.examples=4",
    "validation.pictures=2",
    "sampler.steps=2",
]
_PREPARED = [
    "category=hydrant",
    "data.train_sequences=2",
    "data.test_sequences=1",
    "data.frames=12",
    "data.image_size=32",
    "prep.image_size=32",
    "prep.max_gap_deg=60",
    "workers=1",
]
_COMMANDS = {
    "training": ["extrap_train", *_TRAINED],
    "sweep": ["extrap_train", "-m", "seed=0,1", *_TRAINED],
    "preparation": ["data_prep", *_PREPARED],
    "benchmark": ["benchmarks", "run", "greys", "methods=[dark,light]", "--workers", "1"],
}
_PREPARED_FOLDERS = ("data", "frames", "pairs")
_MADE = {"training": ["train"], "sweep": ["train", "sweep"], "benchmark": ["greys"]}
_MADE |= {"preparation": [*_PREPARED_FOLDERS]}
_STATUS = {signal.SIGKILL: -signal.SIGKILL, signal.SIGINT: 130, signal.SIGTERM: 143}
pytestmark = pytest.mark.slow


def _start(output: Path, command: str) -> "subprocess.Popen[bytes]":
    words = [*_COMMANDS[command], f"output={output}"]
    if command == "sweep":
        words += [f"hydra.sweep.dir={output / 'sweep'}"]
    if command == "benchmark":
        own = output.parent / "own"
        words += ["--config-dir", str(own if own.is_dir() else write_own(own))]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    output.mkdir(exist_ok=True)
    with (output.parent / f"{output.name}.log").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-m", *words],
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
            # A background shell's children ignore Ctrl-C.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )


def _said(output: Path) -> str:
    return (output.parent / f"{output.name}.log").read_text()


def _results(output: Path) -> dict[str, object]:
    """Weights, pictures and pairs by their bytes, tables without times, by their place."""
    found: dict[str, object] = {}
    places = ["train/*/*/seed*", *_PREPARED_FOLDERS, "greys/cells"]
    files = [path for place in places for path in output.glob(f"{place}/**/*") if path.is_file()]
    for path in sorted(files):
        name = str(path.relative_to(output))
        if path.suffix == ".parquet":  # without the identity of the files that it was made from
            found[name] = pd.read_parquet(path).to_csv()
        elif path.suffix in (".safetensors", ".png", ".npy"):
            found[name] = path.read_bytes()
        elif path.name in ("metrics.csv", "validation.csv"):
            found[name] = path.read_text()
    for table in ("sweep/sweep.csv", "greys/greys.csv"):
        if (output / table).is_file():
            rows = pd.read_csv(output / table)
            rows = rows.drop(columns=[*{"seconds", "folder", "output"} & {*rows}])
            if "metric" in rows:
                rows = rows[~rows["metric"].isin(["seconds", "peak_memory_mib"])]
            else:
                rows = rows.drop(columns="status")  # `reused` after an interruption
            found[table] = rows.to_csv()
    assert found
    return found


def _leftovers(output: Path) -> list[Path]:
    return [*output.rglob(".*.tmp*"), *output.glob("greys/*/.*/")]


@pytest.fixture(scope="module", params=list(_COMMANDS))
def undisturbed(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Path]:
    output = tmp_path_factory.mktemp(request.param) / "undisturbed"
    process = _start(output, request.param)
    assert process.wait(timeout=900) == 0, _said(output)
    assert not _leftovers(output)
    return request.param, output


@pytest.mark.parametrize("number", list(_STATUS), ids=lambda number: number.name)
def test_a_command_that_is_ended_again_and_again_leaves_the_same(
    undisturbed: tuple[str, Path], tmp_path: Path, number: signal.Signals
) -> None:
    command, whole = undisturbed
    output = tmp_path / "disturbed"
    started = time.monotonic()
    rng = random.Random(f"{command} {number}")
    took = _seconds(whole, command, tmp_path)
    for _ in range(4):
        process = _start(output, command)
        try:
            process.wait(timeout=rng.uniform(0.1, 1.0) * took)
            break  # it came to its end
        except subprocess.TimeoutExpired:
            process.send_signal(number)
        # before and behind the part that answers signals, the interpreter's own end may come first
        assert process.wait(timeout=300) in (_STATUS[number], -number), _said(output)
    process = _start(output, command)
    assert process.wait(timeout=900) == 0, _said(output)
    assert "Traceback" not in _said(output)
    assert _results(output) == _results(whole), f"after {time.monotonic() - started:.0f} s"
    assert not _leftovers(output)


def _seconds(whole: Path, command: str, folder: Path) -> float:
    """How long the command takes where its data are there."""
    copy = folder / "timed"
    shutil.copytree(whole, copy, symlinks=True)
    for part in _MADE[command]:
        shutil.rmtree(copy / part)
    started = time.monotonic()
    assert _start(copy, command).wait(timeout=900) == 0, _said(copy)
    return time.monotonic() - started


def _size(output: Path) -> int:
    """Bytes of the blocks that the files take, as a file system in memory counts them."""
    return sum(-(-path.stat().st_size // 4096) * 4096 for path in output.rglob("*"))


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Mounts file systems in memory with some options; skips where that is not permitted."""
    mounted: list[Path] = []

    def mount(options: str) -> Path:
        place = tmp_path / "disk"
        place.mkdir()
        words = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(place)]
        if shutil.which("mount") is None or subprocess.run(words, capture_output=True).returncode:
            pytest.skip("mounting a file system is not permitted")
        mounted.append(place)
        # What is said must not fill the disk, nor what the command needs.
        (tmp_path / "disk.log").touch()
        return place

    yield mount
    for place in mounted:
        subprocess.run(["umount", str(place)], check=True)


def _require_one_line(said: str) -> None:
    assert "Traceback" not in said
    errors = [line for line in said.splitlines() if line.startswith("error:")]
    assert len(errors) == 1, said


@pytest.mark.parametrize("share", [0.15, 0.5, 0.9])
def test_a_full_disk_is_one_line_and_the_command_goes_on_with_more_room(
    undisturbed: tuple[str, Path], tmp_path: Path, disk: Callable[[str], Path], share: float
) -> None:
    """A share of what the results need."""
    command, whole = undisturbed
    output = disk(f"size={int(share * _size(whole))}")
    process = _start(output, command)
    assert process.wait(timeout=900) == 1, _said(output)
    _require_one_line(_said(output))
    roomy = tmp_path / "roomy"
    shutil.copytree(output, roomy, symlinks=True)
    assert not _leftovers(roomy)
    process = _start(roomy, command)
    assert process.wait(timeout=900) == 0, _said(roomy)
    assert _results(roomy) == _results(whole)


def test_a_disk_that_cannot_be_written_is_one_line(
    undisturbed: tuple[str, Path], disk: Callable[[str], Path]
) -> None:
    command, _ = undisturbed
    output = disk("ro")
    assert _start(output, command).wait(timeout=900) == 1, _said(output)
    _require_one_line(_said(output))
