"""Killed workers and killed runs: the table ends as an undisturbed one's."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from tests.benchmarks.tables import write_own


def _command(own: Path, output: Path, methods: str) -> list[str]:
    words = ["run", "greys", f"output={output}", f"methods=[{methods}]", "--config-dir", str(own)]
    return [sys.executable, "-m", "benchmarks", *words, "--workers", "2"]


def _run(own: Path, output: Path, methods: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(_command(own, output, methods), capture_output=True, text=True)


def _table(output: Path) -> pd.DataFrame:
    table = pd.read_csv(output / "greys" / "greys.csv")
    return table[~table["metric"].isin(["seconds", "peak_memory_mib"])].reset_index(drop=True)


def test_a_worker_that_is_killed_is_a_failed_cell_and_the_rest_goes_on(tmp_path: Path) -> None:
    own = write_own(tmp_path / "own")
    result = _run(own, tmp_path / "out", "dark,killer,light")
    assert result.returncode == 1, result.stdout + result.stderr
    table = _table(tmp_path / "out")
    states = table.groupby("method")["status"].first()
    assert dict(states) == {"dark": "ok", "killer": "failed", "light": "ok"}
    reasons = table[table["method"] == "killer"]["reason"]
    assert reasons.str.contains("killed").all()


@pytest.mark.slow
def test_runs_killed_at_random_moments_end_in_the_same_table(tmp_path: Path) -> None:
    """`kill -9` of the whole run, and of one of its workers, ten times in turn."""
    own = write_own(tmp_path / "own")
    calm = _run(own, tmp_path / "calm", "dark,light")
    assert calm.returncode == 0, calm.stderr
    rng = random.Random(0)
    for index in range(10):
        output = tmp_path / f"killed{index}"
        run = subprocess.Popen(
            _command(own, output, "dark,light"),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        time.sleep(rng.uniform(3, 25))
        victim = _a_worker(run.pid) if index % 2 else run.pid
        if victim is not None:
            os.kill(victim, signal.SIGKILL)
        run.wait()
        again = _run(own, output, "dark,light")
        assert again.returncode == 0, again.stderr
        pd.testing.assert_frame_equal(_table(output), _table(tmp_path / "calm"))


def _a_worker(parent: int) -> int | None:
    children = Path(f"/proc/{parent}/task/{parent}/children")
    if not children.exists():
        return None
    pids = [int(pid) for pid in children.read_text().split()]
    return pids[-1] if pids else None
