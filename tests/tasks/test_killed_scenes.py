"""Tasks about a scene that are killed or interrupted at random moments: real processes, real files.

`python -m pytest -m slow tests/tasks/test_killed_scenes.py`
"""

import hashlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow  # every case starts half a dozen processes

_SCENE = ["category=cup", "scene=synthetic:cup/0000", "data.frames=6", "data.image_size=48"]
_TASKS = {
    "view": ["inputs=3", "orbit=90", "frames=6", "weights=ours-cup"],
    "scene": [
        "inputs=3",
        "weights=ours-cup",
        "minutes=60",
        "lora.steps=6",
        "lora.validate_every=3",
        "lora.batch_size=2",
    ],
    "complete": [
        "inputs=3",
        "complete.generator=exact",
        "complete.exact_size=40",
        "complete.step_deg=60",
        "complete.splats.fit=false",
    ],
}
_ENDED = {signal.SIGKILL: -9, signal.SIGINT: 130, signal.SIGTERM: 143}
_KILLS = 5


def _start(task: str, output: Path) -> "subprocess.Popen[bytes]":
    options = [f"task={task}", *_SCENE, *_TASKS[task], "threads=1", f"output={output}"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    output.mkdir(parents=True, exist_ok=True)
    with (output / "log.txt").open("wb") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "extrap_train", *options],
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
            # A background shell's children ignore Ctrl-C.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )


def _contents(output: Path) -> dict[str, str]:
    """The digests of pictures, clouds and weights; tables of seconds differ from run to run."""
    ends = (".png", ".gif", ".ply", ".safetensors")
    files = [path for path in sorted(output.rglob("*")) if path.suffix in ends]
    return {
        str(path.relative_to(output)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


@pytest.mark.parametrize("task", list(_TASKS))
def test_whatever_ends_a_task_the_result_is_an_undisturbed_run_s(task: str, tmp_path: Path) -> None:
    undisturbed, disturbed = tmp_path / "undisturbed", tmp_path / "disturbed"
    started = time.monotonic()
    assert _start(task, undisturbed).wait() == 0, (undisturbed / "log.txt").read_text()
    whole_s = time.monotonic() - started
    draw = random.Random(18)
    for number in range(_KILLS):
        sent = [signal.SIGKILL, signal.SIGINT, signal.SIGTERM][number % 3]
        process = _start(task, disturbed)
        try:
            process.wait(timeout=whole_s * draw.uniform(0.3, 1.0))
        except subprocess.TimeoutExpired:
            process.send_signal(sent)
        said = f"{sent.name}: {process.wait()} {(disturbed / 'log.txt').read_text()}"
        assert process.returncode in (0, _ENDED[sent]), said
        assert "Traceback" not in said
    assert _start(task, disturbed).wait() == 0, (disturbed / "log.txt").read_text()
    assert _contents(disturbed) == _contents(undisturbed)
    assert not list(disturbed.rglob(".*.tmp"))
