"""Whatever a method does is its own row, and every other row is as without it."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from multiprocessing.context import ForkServerContext
from pathlib import Path

import pandas as pd
import pytest

from benchmarks.catalogue import Catalogue
from benchmarks.report.aggregate import read_results
from benchmarks.report.verify import verify
from benchmarks.run.cells import Cell
from benchmarks.run.plan import TableFolder
from benchmarks.run_table import RunOptions, run_table
from tests.benchmarks.rogues import BEFORE, ENDS, HANGS, LEFTOVERS, SOUND, STATE, write_rogues
from tests.benchmarks.tables import without_plots

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="asks /proc for processes")


_SEARCH = """
import gc, hashlib, json, os, sys
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.methods.base import Synthesis


@dataclass(frozen=True)
class Search:
    root: str = ""

    def weight_files(self, category):
        return ()

    def synthesize(self, inputs):
        count, size = len(inputs.targets.world_to_cam), inputs.targets.height
        files = [p for p in Path(self.root).rglob("*") if p.is_file()]
        digests = [hashlib.sha256(p.read_bytes()).hexdigest() for p in files]
        scenes, frame = 0, sys._getframe()
        while frame is not None:
            for value in frame.f_locals.values():
                try:
                    scenes += value.truth() is not None
                except Exception:
                    pass
            frame = frame.f_back
        stacks = sum(
            isinstance(found, torch.Tensor) and tuple(found.shape) == (count, 3, size, size)
            for found in gc.get_objects()
        )
        opened = [os.readlink(f"/proc/self/fd/{n}") for n in os.listdir("/proc/self/fd")
                  if os.path.lexists(f"/proc/self/fd/{n}")]
        inside = sum(str(self.root) in name and "(deleted)" in name for name in opened)
        found = {"scenes": scenes, "stacks": stacks, "opened": inside}
        images = torch.zeros(count, 3, size, size)
        return Synthesis(images, 0.1, {"digests": " ".join(sorted(digests))}, None, found)
"""


@pytest.fixture(scope="module")
def rogues(fork_server: ForkServerContext, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_rogues(tmp_path_factory.mktemp("rogues"))
    (folder / "search_method.py").write_text(_SEARCH)
    (folder / "method" / "search.yaml").write_text("factory: search_method.Search\noptions: {}\n")
    return folder


def _run(
    rogues: Path, output: Path, names: list[str], *words: str, workers: int = 1
) -> dict[str, Cell]:
    """The rows of a table of some rogues and two methods that do no harm."""
    catalogue = Catalogue.with_own([str(rogues)])
    methods = ",".join([*names, "honest", "inpainted"])
    overrides = [f"output={output}", f"methods=[{methods}]", *words]
    before = _sleepers()
    with without_plots():
        run_table(catalogue.table("rogues", overrides), catalogue, RunOptions(workers=workers))
    assert _sleepers() <= before
    folder = TableFolder(output / "rogues")
    assert verify(folder).problems == []
    for name in ("rogues.csv", "rogues.md", "rogues.tex", "index.html"):
        assert (folder.path / name).stat().st_size > 100
    return {cell.method: cell for cell in read_results(folder).cells}


def _sleepers() -> set[int]:
    """Processes that rogues leave behind."""
    found = set()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if b"sleep\0" + b"3000" in (entry / "cmdline").read_bytes():
                found.add(int(entry.name))
        except OSError:
            continue
    return found


@pytest.fixture(scope="module")
def honest_output(rogues: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a table without any rogue."""
    output = tmp_path_factory.mktemp("honest")
    _run(rogues, output, [])
    return output


@pytest.fixture(scope="module")
def honest(honest_output: Path) -> dict[str, Cell]:
    cells = read_results(TableFolder(honest_output / "rogues")).cells
    return {cell.method: cell for cell in cells}


def _require_rows(
    cells: dict[str, Cell], honest: dict[str, Cell], failed: dict[str, str], ok: list[str]
) -> None:
    for name in ("honest", "inpainted"):
        assert cells[name].status == "ok"
        assert cells[name].images == honest[name].images, name
        assert cells[name].metrics == honest[name].metrics, name
    states = {name: (cells[name].status, cells[name].reason) for name in (*failed, *ok)}
    wrong = {name: state for name, state in states.items() if name in ok and state != ("ok", "")}
    wrong |= {
        name: state
        for name, state in states.items()
        if name in failed and (state[0] != "failed" or failed[name] not in state[1])
    }
    assert not wrong
    assert all(cell.reason.isprintable() for cell in cells.values())


def test_a_rogue_is_a_row_and_the_others_are_as_without_it(
    rogues: Path, honest: dict[str, Cell], tmp_path: Path
) -> None:
    """The gravest of those below."""
    ends = ["exit", "kill", "bad_text", "forged", "seconds_nan", "seconds_negative"]
    ends += ["count_float32"]
    ok = ["default_dtype", "chdir", "thread", "orphan", "interrupts_parent"]
    cells = _run(rogues, tmp_path, [*ends, *ok])
    _require_rows(cells, honest, {name: ENDS[name][1] for name in ends}, ok)


def test_what_a_module_does_before_it_makes_images_is_its_own_row(
    rogues: Path, honest: dict[str, Cell], tmp_path: Path
) -> None:
    cells = _run(rogues, tmp_path, [*BEFORE])
    failed = {name: reason for name, (_, _, reason) in BEFORE.items() if reason}
    _require_rows(cells, honest, failed, [name for name in BEFORE if name not in failed])


@pytest.mark.slow
def test_every_rogue_that_ends_is_a_row(
    rogues: Path, honest: dict[str, Cell], tmp_path: Path
) -> None:
    ok = [*STATE, *LEFTOVERS, *SOUND]
    assert len(ok) + len(ENDS) + len(HANGS) >= 72
    outside = {path: path.stat().st_mtime_ns for path in Path.cwd().iterdir()}
    cells = _run(rogues, tmp_path / "out", [*ENDS, *ok], workers=2)
    _require_rows(cells, honest, {name: reason for name, (_, reason) in ENDS.items()}, ok)
    assert {path: path.stat().st_mtime_ns for path in Path.cwd().iterdir()} == outside
    assert {path.name for path in tmp_path.iterdir()} == {"out"}


@pytest.mark.slow
def test_a_rogue_that_never_ends_is_ended(
    rogues: Path, honest: dict[str, Cell], tmp_path: Path
) -> None:
    cells = _run(rogues, tmp_path, [*HANGS], "cell_timeout_s=40", workers=2)
    _require_rows(cells, honest, dict.fromkeys(HANGS, "longer than 40 s"), [])


def test_no_truth_is_in_a_methods_reach(rogues: Path, honest_output: Path, tmp_path: Path) -> None:
    """One that reads all files of the results, its own memory and the frames that called it; also
    in a folder with the truths of an earlier run.
    """
    output = Path(shutil.copytree(honest_output, tmp_path / "out"))
    scene = json.loads(next(output.glob("rogues/scenes/*/scene.json")).read_text())
    truth = {d for name, d in scene["files"].items() if not name.startswith("inputs/")}
    kept = {hashlib.sha256(f.read_bytes()).hexdigest() for f in output.rglob("truths/**/*.*")}
    assert truth <= kept
    cell = _run(rogues, output, ["search"], f"options.search.root={output}")["search"]
    assert cell.status == "ok", cell.reason
    read = set(cell.given["digests"].split())
    assert read & set(scene["files"].values())
    assert not read & truth
    assert cell.counts == {"scenes": 0, "stacks": 0, "opened": 0}


@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow)],
)
def test_an_interrupted_run_ends_at_once_and_goes_on_later(
    number: signal.Signals, status: int, rogues: Path, tmp_path: Path
) -> None:
    """The run alone is told, while a method hangs that hears nothing."""
    words = ["run", "rogues", f"output={tmp_path}", "--config-dir", str(rogues), "--workers", "1"]
    command = [sys.executable, "-m", "benchmarks", *words, "methods=[honest,deaf]"]
    before = _children_of_init()
    run = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell's job ignores it
    )
    ends = time.monotonic() + 300
    while not list(tmp_path.glob("rogues/cells/*/cell.json")):
        assert run.poll() is None
        assert time.monotonic() < ends
        time.sleep(0.05)
    time.sleep(0.5)
    os.kill(run.pid, number)
    out, err = run.communicate(timeout=120)
    assert run.returncode == status, out + err
    assert "Traceback" not in out + err
    assert "1 of 2 cells are kept" in err.splitlines()[-1]
    assert _children_of_init() <= before
    assert list(tmp_path.glob("rogues/truths/*/truth/0.png"))
    frame = pd.read_json(next(tmp_path.glob("rogues/cells/*/cell.json")), typ="series")
    assert frame["status"] == "made"


def _children_of_init() -> set[int]:
    """Processes of this project whose parent has gone."""
    found = set()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == 1 and b"multiprocessing" in (entry / "cmdline").read_bytes():
                found.add(int(entry.name))
        except OSError:
            continue
    return found
