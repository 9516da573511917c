"""The main job on a tiny category: what it leaves, that it is repeatable, and that no kill changes
its result.
"""

import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from in_process import run_command
from tiny_job import TINY

from extrap_train.__main__ import main

_OPTIONS = [
    *TINY,
    "trainer.steps=12",
    "trainer.checkpoint_every=3",
    "trainer.validate_every=6",
    "validation.examples=4",
    "validation.pictures=2",
    "sampler.steps=2",
]


def _arguments(output: Path, *more: str) -> list[str]:
    return [*_OPTIONS, f"output={output}", *more]


def _start(output: Path) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "extrap_train", *_arguments(output)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    with (output / "log.txt").open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)


def _said(output: Path) -> str:
    return (output / "log.txt").read_text()


def _finish(output: Path, *more: str) -> str:
    """Run the job in this process, to its end."""
    return run_command(main, *_arguments(output, *more))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("undisturbed")
    _finish(output)
    return output


def _run_folder(output: Path) -> Path:
    return (output / "train/hydrant/small/latest").resolve()


def _weights(output: Path) -> dict[str, bytes]:
    run = _run_folder(output)
    files = (run / "model").rglob("*.safetensors")
    return {str(p.relative_to(run)): p.read_bytes() for p in files}


def test_the_contract_of_files_is_kept(undisturbed: Path) -> None:
    run = _run_folder(undisturbed)
    names = {path.name for path in run.iterdir()}
    expected = {"config.yaml", "metrics.csv", "samples", "checkpoints", "model", "summary.json"}
    assert expected <= names
    summary = json.loads((run / "summary.json").read_text())
    assert list(summary["validation"]) == ["model", "nearest", "inpainted", "mean_fill"]
    for row in summary["validation"].values():
        assert {"psnr", "psnr_holes", "ssim", "lpips"} <= row.keys()
        assert row["psnr_object"] not in (None, row["psnr"])  # the sequences have masks
    assert set(summary["seconds"]) == {"prepare", "train", "validate"}
    assert summary["steps"] == 12
    for name, reason in summary["missing"].items():
        assert summary["validation"]["model"][name] is None
        assert reason
    table = pd.read_csv(run / "metrics.csv")
    assert table["step"].is_monotonic_increasing
    assert table["validation/psnr"].notna().sum() == 2
    assert (run / "samples" / "final.png").stat().st_size > 1000


def test_a_second_run_says_that_it_is_done(undisturbed: Path) -> None:
    before = _weights(undisturbed)
    text = _finish(undisturbed, "trainer.steps=9")  # of the 12 that it has
    assert "already trained for 12 steps" in text
    assert _weights(undisturbed) == before


@pytest.mark.parametrize("damage", ["flipped", "missing"])
def test_a_damaged_model_is_noticed_and_made_again_from_the_checkpoint(
    undisturbed: Path, tmp_path: Path, damage: str
) -> None:
    shutil.copytree(undisturbed, tmp_path / "copy", symlinks=True)
    before = _weights(tmp_path / "copy")
    file = next((_run_folder(tmp_path / "copy") / "model" / "unet").glob("*.safetensors"))
    content = file.read_bytes()
    file.unlink()
    if damage == "flipped":
        file.write_bytes(content[:-9] + bytes([content[-9] ^ 1]) + content[-8:])
    assert "is made again" in _finish(tmp_path / "copy")
    assert _weights(tmp_path / "copy") == before


def test_a_finished_run_is_measured_again_sampled_otherwise(
    undisturbed: Path, tmp_path: Path
) -> None:
    shutil.copytree(undisturbed, tmp_path / "copy", symlinks=True)
    run = _run_folder(tmp_path / "copy")
    before = (run / "summary.json").read_bytes()
    _finish(tmp_path / "copy", "task=validate")
    for _ in range(2):  # the second time in the place of the first
        _finish(tmp_path / "copy", "task=validate", "sampler.steps=1")
    found = [json.loads(file.read_text()) for file in run.glob("validations/*/summary.json")]
    scores = [summary["validation"] for summary in found]
    own = json.loads(before)["validation"]
    assert len(scores) == 2
    assert [score["model"] == own["model"] for score in scores].count(True) == 1
    assert all(score["nearest"] == own["nearest"] for score in scores)
    assert all(summary["steps"] == 12 for summary in found)
    assert (run / "summary.json").read_bytes() == before


def _run_until_killed(output: Path, module: str, owner: str, name: str, where: str) -> None:
    """A job that kills itself where `module.owner.name(…)` is called, of a file half-written if it
    saves one, and one of the arguments says `where`.
    """
    holder = getattr(importlib.import_module(module), owner)
    really = getattr(holder, name)

    def killed(*arguments: Any, **options: Any) -> Any:
        if where in str(arguments):
            if name == "save":
                Path(arguments[1]).write_bytes(b"half")
            os.kill(os.getpid(), signal.SIGKILL)
        return really(*arguments, **options)

    setattr(holder, name, killed)
    _finish(output)


def _kill_at_file(output: Path, pattern: str) -> None:
    """Start the job and kill it once such a file is there."""
    process = _start(output)
    while process.poll() is None and not any(output.glob(pattern)):
        time.sleep(0.02)
    assert process.poll() is None, _said(output)
    process.send_signal(signal.SIGKILL)
    process.wait()


def _kill_within(server: ForkServerContext, output: Path, *place: str) -> None:
    process = server.Process(target=_run_until_killed, args=(output, *place))
    process.start()
    process.join(timeout=300)
    assert process.exitcode == -signal.SIGKILL


_WITHIN_CHECKPOINT = ("extrap_train.diffusion.checkpoints", "torch", "save", "step-00000006")
_WITHIN_VALIDATION = ("extrap_train.diffusion", "evaluation", "sample_views", "")


def _checkpoints(output: Path) -> list[str]:
    return [path.name for path in (_run_folder(output) / "checkpoints").glob("step-*")]


def test_killed_within_a_checkpoint_the_weights_are_the_same(
    fork_server: ForkServerContext, undisturbed: Path, tmp_path: Path
) -> None:
    """SIGKILL with half of the checkpoint written; then run to the end."""
    _link_data(undisturbed, tmp_path)
    _kill_within(fork_server, tmp_path, *_WITHIN_CHECKPOINT)
    assert _checkpoints(tmp_path) == ["step-00000003.ckpt"], "killed within writing the second"
    _finish(tmp_path)
    _require_same(tmp_path, undisturbed)


@pytest.mark.slow
def test_killed_again_and_again_the_weights_are_the_same(
    fork_server: ForkServerContext, undisturbed: Path, tmp_path: Path
) -> None:
    """SIGKILL while sequences are rendered, within the writing of a checkpoint, within the
    validation behind it, and right after the last one; then run to the end.
    """
    _kill_at_file(tmp_path, "synthetic/hydrant/0000/**/*.jpg")
    _kill_within(fork_server, tmp_path, *_WITHIN_CHECKPOINT)
    _kill_within(fork_server, tmp_path, *_WITHIN_VALIDATION)
    assert not (_run_folder(tmp_path) / "metrics.csv").read_text().count("validation/")
    _kill_at_file(tmp_path, "train/hydrant/small/*/checkpoints/step-00000012.ckpt")
    _finish(tmp_path)
    _require_same(tmp_path, undisturbed)


def _link_data(source: Path, output: Path) -> None:
    """Let a job use the rendered and prepared data of another."""
    for name in ("synthetic", "data", "frames", "pairs"):
        (output / name).symlink_to(source / name)


def _require_same(output: Path, undisturbed: Path) -> None:
    assert _weights(output) == _weights(undisturbed)
    pd.testing.assert_frame_equal(_metrics(undisturbed), _metrics(output))


def _metrics(output: Path) -> pd.DataFrame:
    return pd.read_csv(_run_folder(output) / "metrics.csv")


def test_a_run_killed_behind_its_last_step_still_ends(undisturbed: Path, tmp_path: Path) -> None:
    """No step is left to train, but the averaged weights, the pictures and the summary are."""
    shutil.copytree(undisturbed, tmp_path / "copy", symlinks=True)
    run = _run_folder(tmp_path / "copy")
    (run / "summary.json").unlink()
    shutil.rmtree(run / "model")
    _finish(tmp_path / "copy")
    assert _weights(tmp_path / "copy") == _weights(undisturbed)
    assert (run / "summary.json").is_file()


def test_a_training_goes_on_with_changed_options_that_change_nothing_learnt(
    undisturbed: Path, tmp_path: Path
) -> None:
    """A longer training continues where the shorter ended. How often it saves and measures, and
    which process loads batches, change on the way.
    """
    _link_data(undisturbed, tmp_path)
    _finish(tmp_path, "trainer.steps=4", "trainer.checkpoint_every=2", "trainer.validate_every=4")
    first = _run_folder(tmp_path)
    changed = ["trainer.checkpoint_every=5", "trainer.validate_every=5", "trainer.workers=1"]
    _finish(tmp_path, *changed, "trainer.accelerator=cpu")
    assert _run_folder(tmp_path) == first
    assert first.name == _run_folder(undisturbed).name
    assert _weights(tmp_path) == _weights(undisturbed)


def test_what_a_run_starts_from_is_measured_once_on_the_same_views(
    undisturbed: Path, tmp_path: Path
) -> None:
    _link_data(undisturbed, tmp_path)
    start = f"model.start={_run_folder(undisturbed) / 'model'}"
    trained = json.loads((_run_folder(undisturbed) / "summary.json").read_text())
    for steps in (2, 3):  # the second goes on where the first ended
        _finish(tmp_path, start, f"trainer.steps={steps}", "trainer.validate_every=3")
        summary = json.loads((_run_folder(tmp_path) / "summary.json").read_text())
        scores = summary["validation"]["start"]
        assert scores["psnr"] == pytest.approx(trained["validation"]["model"]["psnr"], abs=1e-3)
    _finish(tmp_path, start, "trainer.steps=3", "validation.examples=3")
    summary = json.loads((_run_folder(tmp_path) / "summary.json").read_text())
    assert "start" not in summary["validation"]
    assert "start" in summary["missing"]
