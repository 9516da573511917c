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

_OPTIONS = [
    *TINY,
    "trainer.steps=12",
    "trainer.checkpoint_every=3",
    "trainer.validate_every=6",
    "validation.examples=4",
    "validation.pictures=2",
    "sampler.steps=2",
]
_COMMANDS = {"training": [], "sweep": ["-m", "seed=0,1"]}
_STATUS = {signal.SIGKILL: -signal.SIGKILL, signal.SIGINT: 130, signal.SIGTERM: 143}
pytestmark = pytest.mark.slow


def _start(output: Path, command: str) -> "subprocess.Popen[bytes]":
    words = [*_COMMANDS[command], *_OPTIONS, f"output={output}"]
    words += [f"hydra.sweep.dir={output / 'sweep'}"] if command == "sweep" else []
    environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    output.mkdir(exist_ok=True)
    with (output.parent / f"{output.name}.log").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "extrap_train", *words],
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
        )


def _said(output: Path) -> str:
    return (output.parent / f"{output.name}.log").read_text()


def _results(output: Path) -> dict[str, object]:
    """Weights by their bytes, tables without times, by their place in `output`."""
    found: dict[str, object] = {}
    for path in sorted(output.glob("train/*/*/seed*/**/*")):
        name = str(path.relative_to(output))
        if path.suffix == ".safetensors":
            found[name] = path.read_bytes()
        if path.name in ("metrics.csv", "validation.csv"):
            found[name] = path.read_text()
    table = output / "sweep" / "sweep.csv"
    if table.is_file():
        rows = pd.read_csv(table).drop(columns=["seconds", "folder", "status"])
        found["sweep.csv"] = rows.drop(columns="output").to_csv()
    return found


def _leftovers(output: Path) -> list[Path]:
    return [path for path in output.rglob(".*.tmp*") if path.exists()]


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
    for part in ("train", "sweep"):
        shutil.rmtree(copy / part, ignore_errors=True)
    started = time.monotonic()
    assert _start(copy, command).wait(timeout=900) == 0, _said(copy)
    return time.monotonic() - started


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """Mounts file systems of so many MiB; skips where that is not permitted."""
    mounted: list[Path] = []

    def mount(size_mib: int) -> Path:
        place = tmp_path / f"disk-{size_mib}"
        place.mkdir()
        words = ["mount", "-t", "tmpfs", "-o", f"size={size_mib}m", "tmpfs", str(place)]
        if shutil.which("mount") is None or subprocess.run(words, capture_output=True).returncode:
            pytest.skip("mounting a file system is not permitted")
        mounted.append(place)
        return place

    yield mount
    for place in mounted:
        subprocess.run(["umount", str(place)], check=True)


@pytest.mark.parametrize("size_mib", [1, 6, 14])
def test_a_full_disk_is_one_line_and_the_command_goes_on_with_more_room(
    undisturbed: tuple[str, Path],
    tmp_path: Path,
    small_disk: Callable[[int], Path],
    size_mib: int,
) -> None:
    """Too small for the data, for a checkpoint, and for the second one with the model."""
    command, whole = undisturbed
    output = small_disk(size_mib) / "full"
    log = tmp_path / f"disk-{size_mib}" / "full.log"
    log.symlink_to(tmp_path / f"full-{size_mib}.log")  # what is said must not fill the disk
    process = _start(output, command)
    assert process.wait(timeout=900) == 1, _said(output)
    said = _said(output)
    assert "Traceback" not in said
    errors = [line for line in said.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    roomy = tmp_path / "roomy"
    shutil.copytree(output, roomy, symlinks=True)
    assert not _leftovers(roomy)
    process = _start(roomy, command)
    assert process.wait(timeout=900) == 0, _said(roomy)
    assert _results(roomy) == _results(whole)
