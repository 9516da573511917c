"""Killed workers and killed runs: the table ends as an undisturbed one's."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from tests.benchmarks.tables import run_greys, write_own


def _command(own: Path, output: Path, methods: str) -> list[str]:
    words = ["run", "greys", f"output={output}", f"methods=[{methods}]", "--config-dir", str(own)]
    return [sys.executable, "-m", "benchmarks", *words, "--workers", "2"]


def _run(own: Path, output: Path, methods: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(_command(own, output, methods), capture_output=True, text=True)


def _table(output: Path) -> pd.DataFrame:
    table = pd.read_csv(output / "greys" / "greys.csv")
    return table[~table["metric"].isin(["seconds", "peak_memory_mib"])].reset_index(drop=True)


def test_a_worker_that_is_killed_is_a_failed_cell_and_the_rest_goes_on(
    own: Path, tmp_path: Path
) -> None:
    assert run_greys(own, tmp_path, "methods=[dark,killer,light]", workers=2, quick=True) == 1
    table = _table(tmp_path)
    states = table.groupby("method")["status"].first()
    assert dict(states) == {"dark": "ok", "killer": "failed", "light": "ok"}
    reasons = table[table["method"] == "killer"]["reason"]
    assert reasons.str.contains("killed").all()


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pd.DataFrame]:
    """A folder of methods, and its table of a run that nobody has disturbed."""
    folder = tmp_path_factory.mktemp("calm")
    own = write_own(folder / "own")
    result = _run(own, folder / "out", "dark,light")
    assert result.returncode == 0, result.stderr
    return own, _table(folder / "out")


@pytest.mark.slow
@pytest.mark.parametrize(
    "kills",
    # Once the last cell is there, workers end on their own, and the run writes its reports.
    [
        *([("run", count)] for count in range(5)),
        *([("worker", count)] for count in range(4)),
        [("worker", 0), ("run", 2)],
    ],
    ids=lambda kills: "-".join(f"{victim}{finished}" for victim, finished in kills),
)
def test_a_killed_run_ends_in_the_same_table(
    kills: list[tuple[str, int]], calm: tuple[Path, pd.DataFrame], tmp_path: Path
) -> None:
    """`kill -9` of one of its workers, of the whole run, or of one after the other, at every stage:
    of four cells, so many are there, and the others are under way.
    """
    own, undisturbed = calm
    run = subprocess.Popen(
        _command(own, tmp_path, "dark,light"), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )

    def target(victim: str, finished: int) -> int | None:
        there = len(list(tmp_path.glob("greys/cells/*/cell.json"))) >= finished
        has_begun = there and (tmp_path / "greys" / "protocol.json").exists()
        if not has_begun:
            return None
        return run.pid if victim == "run" else _a_worker(run.pid)

    for kill in kills:
        os.kill(_once_there(lambda kill=kill: target(*kill), run), signal.SIGKILL)
    assert run.wait() == (-signal.SIGKILL if kills[-1][0] == "run" else 0)
    again = _run(own, tmp_path, "dark,light")
    assert again.returncode == 0, again.stderr
    pd.testing.assert_frame_equal(_table(tmp_path), undisturbed)


def _once_there(target: Callable[[], int | None], run: subprocess.Popen[bytes]) -> int:
    """The process to kill; a run that ends before there is one has disturbed nothing."""
    while (pid := target()) is None:
        assert run.poll() is None, "the run has ended before anything was killed"
        time.sleep(0.002)
    return pid


def _a_worker(run: int) -> int | None:
    """A method's process: the run's server has forked its supervisor, which has forked it."""
    for server in _children(run):
        for supervisor in _children(server):
            for job in _children(supervisor):
                return job
    return None


def _children(process: int) -> list[int]:
    try:
        found = Path(f"/proc/{process}/task/{process}/children").read_text()
    except OSError:
        return []
    return [int(pid) for pid in found.split()]
