"""One training on two machines, which here are two launchers that meet over the loopback."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
import torch
from safetensors.torch import load_file
from tiny_job import TINY

pytestmark = pytest.mark.slow

_OPTIONS = [
    *TINY,
    "trainer.steps=40",
    "trainer.checkpoint_every=10",
    "trainer.validate_every=40",
    "trainer.accelerator=cpu",
    "validation.examples=2",
    "sampler.steps=1",
    "run=here",
]


def _start(output: Path, *more: str) -> list["subprocess.Popen[str]"]:
    """Both machines' launchers, as a user or a scheduler starts them."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    launcher = [sys.executable, "-m", "torch.distributed.run", "--nnodes=2", "--nproc_per_node=1"]
    where = ["--master_addr=127.0.0.1", f"--master_port={port}"]
    command = ["-m", "extrap_train", *_OPTIONS, f"output={output}", "trainer.num_nodes=2", *more]
    return [
        subprocess.Popen(
            [*launcher, *where, f"--node_rank={node}", *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=_environment(),
        )
        for node in range(2)
    ]


def _environment() -> dict[str, str]:
    one_thread = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    return os.environ | one_thread | {"PYTHONPATH": str(Path(__file__).parents[1])}


def _require_done(machines: list["subprocess.Popen[str]"]) -> list[str]:
    try:
        said = [machine.communicate(timeout=400)[0] for machine in machines]
    finally:  # torchrun ends its processes when it is asked to
        for machine in machines:
            machine.terminate()
    assert [machine.returncode for machine in machines] == [0, 0], "\n".join(said)
    return said


def _run(output: Path) -> Path:
    return output / "train/hydrant/small/here"


def _weights(output: Path) -> dict[str, torch.Tensor]:
    (file,) = (_run(output) / "model/unet").glob("*.safetensors")
    return load_file(file)


def _losses(output: Path) -> list[float]:
    return pd.read_csv(_run(output) / "metrics.csv")["loss"].dropna().tolist()


@pytest.fixture(scope="module")
def two_machines(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What both leave if nothing happens to them."""
    output = tmp_path_factory.mktemp("two")
    said = _require_done(_start(output))
    assert sum(text.count("result:") for text in said) == 1
    return output


def test_two_machines_train_what_one_does_with_their_batches_as_one(
    two_machines: Path, tmp_path: Path
) -> None:
    """The sum of two halves is rounded differently. AdamW amplifies this in weights whose gradient
    is zero, so the loss and the generated views are compared instead of the weights."""
    command = [sys.executable, "-m", "extrap_train", *_OPTIONS, f"output={tmp_path}"]
    alone = [*command, "trainer.batch_size=4"]
    subprocess.run(alone, env=_environment(), check=True, timeout=400, stdout=subprocess.DEVNULL)
    assert len(_losses(tmp_path)) == 2
    assert _losses(two_machines) == pytest.approx(_losses(tmp_path), rel=1e-4)
    psnr = [
        json.loads((_run(output) / "summary.json").read_text())["validation"]["model"]["psnr"]
        for output in (two_machines, tmp_path)
    ]
    assert psnr[0] == pytest.approx(psnr[1], abs=0.01)


def test_a_requeued_training_ends_as_if_it_had_not_been_killed(
    two_machines: Path, tmp_path: Path
) -> None:
    machines = _start(tmp_path)
    checkpoints = _run(tmp_path) / "checkpoints"
    deadline = time.monotonic() + 300
    while not list(checkpoints.glob("*.ckpt")):
        assert time.monotonic() < deadline
        assert all(machine.poll() is None for machine in machines)
        time.sleep(0.05)
    for machine in machines:
        children = Path(f"/proc/{machine.pid}/task/{machine.pid}/children").read_text().split()
        for process in [machine.pid, *map(int, children)]:
            os.kill(process, signal.SIGKILL)
        machine.communicate()
    said = _require_done(_start(tmp_path))
    assert any("resuming at step" in text for text in said)
    assert _losses(tmp_path) == _losses(two_machines)
    expected = _weights(two_machines)
    assert all(torch.equal(found, expected[name]) for name, found in _weights(tmp_path).items())
