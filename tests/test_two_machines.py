"""One training on two machines, which here are two launchers that meet over the loopback, or two
nodes of a SLURM cluster:

    tests/slurm/cluster.sh 2 python -m pytest -m slow tests/test_two_machines.py
"""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
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


def _command(output: Path) -> list[str]:
    return ["-m", "extrap_train", *_OPTIONS, f"output={output}", "trainer.num_nodes=2"]


class TwoLaunchers:
    """Both machines' launchers, as a user starts them."""

    def __init__(self, output: Path) -> None:
        self.output = output

    def start(self) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        launcher = [sys.executable, "-m", "torch.distributed.run", "--nnodes=2"]
        where = ["--nproc_per_node=1", "--master_addr=127.0.0.1", f"--master_port={port}"]
        self._machines = [
            subprocess.Popen(
                [*launcher, *where, f"--node_rank={node}", *_command(self.output)],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                env=_environment(),
            )
            for node in range(2)
        ]

    @property
    def is_running(self) -> bool:
        return all(machine.poll() is None for machine in self._machines)

    def require_done(self) -> str:
        try:
            said = [machine.communicate(timeout=400)[0] for machine in self._machines]
        finally:  # torchrun ends its processes when it is asked to
            for machine in self._machines:
                machine.terminate()
        assert [machine.returncode for machine in self._machines] == [0, 0], "\n".join(said)
        return "\n".join(said)

    def kill(self) -> None:
        for machine in self._machines:
            children = Path(f"/proc/{machine.pid}/task/{machine.pid}/children").read_text().split()
            for process in [machine.pid, *map(int, children)]:
                os.kill(process, signal.SIGKILL)
            machine.communicate()

    def restart(self) -> None:
        """The same command again."""
        self.start()


class SlurmJob:
    """A batch job on two nodes; started again, it is requeued under its number."""

    def __init__(self, output: Path) -> None:
        self.output, self._said = output, output / "said.txt"

    def start(self) -> None:
        # The name of a node of this cluster is no address.
        srun = ["srun", "--kill-on-bad-exit=1", sys.executable, *_command(self.output)]
        script = self.output / "job.sh"
        script.write_text("#!/bin/sh\nexport MASTER_ADDR=127.0.0.1\n" + " ".join(srun) + "\n")
        where = ["--nodes=2", "--ntasks-per-node=1", f"--output={self._said}", "--open-mode=append"]
        self._job = subprocess.run(
            ["sbatch", "--parsable", "--requeue", *where, script],
            check=True,
            capture_output=True,
            text=True,
            env=_environment(),
        ).stdout.strip()

    @property
    def is_running(self) -> bool:
        return self._state in ("PENDING", "RUNNING", "COMPLETING", "CONFIGURING")

    @property
    def _state(self) -> str:
        shown = ["scontrol", "show", "--oneliner", "job", self._job]
        said = subprocess.run(shown, check=True, capture_output=True, text=True).stdout
        return said.partition("JobState=")[2].split()[0]

    def require_done(self) -> str:
        self._wait()
        said = self._said.read_text()
        assert self._state == "COMPLETED", said
        return said

    def _wait(self) -> None:
        deadline = time.monotonic() + 400
        while self.is_running:
            assert time.monotonic() < deadline
            time.sleep(0.2)

    def kill(self) -> None:
        """The processes of both nodes, by the job that they say they belong to."""
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                words = (process / "cmdline").read_bytes().split(b"\0")
                is_task = words[:3] == [sys.executable.encode(), b"-m", b"extrap_train"]
                environment = (process / "environ").read_bytes().split(b"\0")
                if is_task and f"SLURM_JOB_ID={self._job}".encode() in environment:
                    os.kill(int(process.name), signal.SIGKILL)
        self._wait()

    def restart(self) -> None:
        assert self._state == "FAILED"
        subprocess.run(["scontrol", "requeue", self._job], check=True)


Machines = Callable[[Path], TwoLaunchers | SlurmJob]


@pytest.fixture(scope="module", params=[TwoLaunchers, SlurmJob])
def machines(request: pytest.FixtureRequest) -> Machines:
    """What trains on two machines."""
    if request.param is SlurmJob:
        nodes = ["sinfo", "--noheader", "--Node", "--states=idle"]
        if not shutil.which("sinfo") or (
            subprocess.run(nodes, capture_output=True, text=True).stdout.count("\n") < 2
        ):
            pytest.skip("no SLURM cluster with two idle nodes; see tests/slurm/cluster.sh")
    return request.param


def _environment() -> dict[str, str]:
    one_thread = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    return os.environ | one_thread | {"PYTHONPATH": str(Path(__file__).parents[1])}


def _run(output: Path) -> Path:
    return output / "train/hydrant/small/here"


def _weights(output: Path) -> dict[str, torch.Tensor]:
    (file,) = (_run(output) / "model/unet").glob("*.safetensors")
    return load_file(file)


def _losses(output: Path) -> list[float]:
    return pd.read_csv(_run(output) / "metrics.csv")["loss"].dropna().tolist()


@pytest.fixture(scope="module")
def two_machines(machines: Machines, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What both leave if nothing happens to them."""
    output = tmp_path_factory.mktemp("two")
    job = machines(output)
    job.start()
    assert job.require_done().count("result:") == 1
    return output


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What one process leaves that trains with both machines' batches as one."""
    output = tmp_path_factory.mktemp("one")
    command = [sys.executable, "-m", "extrap_train", *_OPTIONS, f"output={output}"]
    whole = [*command, "trainer.batch_size=4"]
    subprocess.run(whole, env=_environment(), check=True, timeout=400, stdout=subprocess.DEVNULL)
    return output


def test_two_machines_train_what_one_does_with_their_batches_as_one(
    two_machines: Path, alone: Path
) -> None:
    """The sum of two halves is rounded differently. AdamW amplifies this in weights whose gradient
    is zero, so the loss and the generated views are compared instead of the weights."""
    assert len(_losses(alone)) == 2
    assert _losses(two_machines) == pytest.approx(_losses(alone), rel=1e-4)
    psnr = [
        json.loads((_run(output) / "summary.json").read_text())["validation"]["model"]["psnr"]
        for output in (two_machines, alone)
    ]
    assert psnr[0] == pytest.approx(psnr[1], abs=0.01)


def test_a_requeued_training_ends_as_if_it_had_not_been_killed(
    machines: Machines, two_machines: Path, tmp_path: Path
) -> None:
    job = machines(tmp_path)
    job.start()
    checkpoints = _run(tmp_path) / "checkpoints"
    deadline = time.monotonic() + 300
    while not list(checkpoints.glob("*.ckpt")):
        assert time.monotonic() < deadline
        assert job.is_running
        time.sleep(0.05)
    job.kill()
    job.restart()
    assert "resuming at step" in job.require_done()
    assert _losses(tmp_path) == _losses(two_machines)
    expected = _weights(two_machines)
    assert all(torch.equal(found, expected[name]) for name, found in _weights(tmp_path).items())
