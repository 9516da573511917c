"""A category that is rendered and prepared by a Ray cluster of this one machine.
`python -m pytest -m slow tests/data_prep/test_preparation_on_ray.py`
"""

import ctypes
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from test_killed_preparations import contents, finish, wait_until

pytestmark = pytest.mark.slow  # a cluster takes seconds to start, and a core

_SEQUENCES = 8
_RENDERED = [
    "category=hydrant",
    "data.test_sequences=1",
    f"data.train_sequences={_SEQUENCES - 1}",
    "data.frames=12",
    "data.image_size=64",
    "prep.image_size=64",
    "prep.max_gap_deg=60",
]


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """Its address. It ends with the test, whatever happens: its processes are one group."""
    pytest.importorskip("ray")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    place = tempfile.mkdtemp(prefix="ray-")  # sockets have short paths
    start = [sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--block"]
    bounds = [
        "--include-dashboard=false",
        "--num-cpus=2",
        f"--memory={3 * 2**30}",
        f"--object-store-memory={80 * 2**20}",
    ]
    where = ["--node-ip-address=127.0.0.1", f"--port={port}", f"--temp-dir={place}"]
    head = subprocess.Popen(
        [*start, *bounds, *where],
        env=os.environ | {"RAY_USAGE_STATS_ENABLED": "0", "PYTHONPATH": str(_repository())},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        preexec_fn=_end_with_parent,
    )
    try:
        wait_until(lambda: _listens(port), head)
        yield f"127.0.0.1:{port}"
    finally:
        head.terminate()
        with suppress(subprocess.TimeoutExpired):
            head.wait(30)
        with suppress(ProcessLookupError):
            os.killpg(head.pid, signal.SIGKILL)
        head.wait()
        shutil.rmtree(place, ignore_errors=True)


def _end_with_parent() -> None:
    """Ray's head ends its processes when it is terminated, here also if the test is killed."""
    pr_set_pdeathsig = 1
    ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGTERM)


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def _repository() -> Path:
    return Path(__file__).parents[2]


def _start(output: Path, *more: str) -> "subprocess.Popen[str]":
    """In a folder of its own, by a relative path: the cluster's processes have others."""
    command = [sys.executable, "-m", "data_prep", *_RENDERED, f"output={output.name}", *more]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=output.parent,
        env=os.environ | {"PYTHONPATH": str(_repository())},
    )


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What processes of this machine make."""
    output = tmp_path_factory.mktemp("local")
    finish(_start(output, "workers=2"))
    return _stored(output)


def test_a_cluster_makes_what_local_processes_make(
    cluster: str, local: dict[str, bytes], tmp_path: Path
) -> None:
    output = tmp_path / "outputs"
    finish(_start(output, "launcher=ray", f"launcher.address={cluster}"))
    assert _stored(output) == local


def test_a_killed_worker_costs_its_own_sequence_alone(
    cluster: str, local: dict[str, bytes], tmp_path: Path
) -> None:
    output = tmp_path / "outputs"
    run = _start(output, "launcher=ray", f"launcher.address={cluster}")
    wait_until(lambda: bool(_prepared(output) and _busy_workers()), run)
    os.kill(_busy_workers()[0], signal.SIGKILL)
    done = {file: file.stat().st_mtime_ns for file in _prepared(output)}
    assert 0 < len(done) < _SEQUENCES, "killed in the middle"
    finish(run)
    assert _stored(output) == local
    assert {file: file.stat().st_mtime_ns for file in done} == done


def _stored(output: Path) -> dict[str, bytes]:
    """Every file but the records of what it was made from: photographs that are rendered again are
    other files, by their times."""
    records = (".seal", "preparation.json")
    return {file: read for file, read in contents(output).items() if not file.endswith(records)}


def _prepared(output: Path) -> list[Path]:
    return [*output.glob("pairs/hydrant-*/*_pairs/hydrant/*/pairs.parquet")]


def _busy_workers() -> list[int]:
    """The cluster's processes that run a job: they are called after it."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if (process / "cmdline").read_bytes().startswith(b"ray::_run_job"):
                found.append(int(process.name))
    return found
