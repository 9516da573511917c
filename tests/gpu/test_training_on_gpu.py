"""The main job on a GPU, its resumption, and how fast a full-size step is."""

from pathlib import Path

import pandas as pd
import pytest
import torch
from in_process import run_command
from safetensors.torch import load_file
from tiny_job import TINY
from torch import Tensor

from benchmarks.perf.average_timing import compare_averages
from benchmarks.perf.diffusion_case import (
    PEAK_TFLOPS,
    batch_of,
    configuration,
    forward_flops,
    optimised,
    plain,
)
from benchmarks.perf.timing import Timing, compare
from benchmarks.perf.train_timing import training_step
from extrap_train.__main__ import main
from extrap_train.diffusion.averaging import AveragedModule, AveragedWeights
from extrap_train.geometry.warp import compute_warp
from extrap_train.views import PairBatch

pytestmark = pytest.mark.gpu
_OPTIONS = [
    *TINY,
    "trainer.accelerator=gpu",
    "trainer.deterministic=true",
    "trainer.checkpoint_every=3",
    "trainer.validate_every=3",
    "validation.examples=2",
    "validation.pictures=1",
    "sampler.steps=1",
]
_BATCH = 4
"""As the paper trains."""


def _train(output: Path, steps: int) -> None:
    run_command(main, *_OPTIONS, f"trainer.steps={steps}", f"output={output}")


def _weights(output: Path) -> dict[str, Tensor]:
    run = (output / "train/hydrant/small/latest").resolve()
    found: dict[str, Tensor] = {}
    for file in sorted((run / "model").rglob("*.safetensors")):
        found |= {f"{file.parent.name}/{name}": x for name, x in load_file(file).items()}
    return found


def test_a_training_and_its_resumption(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """In one go, and prolonged after half; the average lies on the GPU meanwhile."""
    devices: set[str] = set()
    update = AveragedModule.update_parameters

    def seen(self: AveragedModule, model: torch.nn.Module) -> None:
        devices.update(x.device.type for x in (*self.module.parameters(), *model.parameters()))
        update(self, model)

    monkeypatch.setattr(AveragedModule, "update_parameters", seen)
    _train(tmp_path / "whole", 6)
    (tmp_path / "halves").mkdir()
    for name in ("synthetic", "data"):
        (tmp_path / "halves" / name).symlink_to(tmp_path / "whole" / name)
    _train(tmp_path / "halves", 3)
    _train(tmp_path / "halves", 6)
    assert devices == {"cuda"}
    whole, halves = _weights(tmp_path / "whole"), _weights(tmp_path / "halves")
    assert whole.keys() == halves.keys()
    for name, weight in whole.items():  # torch has no repeatable kernel for some operations
        torch.testing.assert_close(weight, halves[name], rtol=1e-3, atol=1e-5)
    table = pd.read_csv((tmp_path / "halves/train/hydrant/small/latest/metrics.csv").resolve())
    assert table["validation/psnr"].notna().sum() == 2


def test_steps_do_not_wait_for_the_gpu_in_the_average(gpu: torch.device) -> None:
    model = torch.nn.Linear(64, 64, device=gpu)
    average = AveragedModule(model, gpu, AveragedWeights(0.9).decay)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(3):
            average.update_parameters(model)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert int(average.n_averaged) == 3


def test_throughput_at_full_size(gpu: torch.device, capsys: pytest.CaptureFixture[str]) -> None:
    """Prints the rows of docs/performance.md; in bf16 a step is faster than in plain float32."""
    model, batch = optimised(configuration(320), gpu), batch_of(_BATCH, gpu)
    references = plain(model)
    step = compare(
        f"training step, full size, batch {_BATCH}",
        gpu,
        training_step(model, lambda: batch, optimised=True),
        training_step(references, lambda: batch, optimised=False),
        repeats=10,
    )
    del model, references
    torch.cuda.empty_cache()
    average, warp = compare_averages(320, gpu), _compare_warps(gpu, batch)
    flops = 3 * _BATCH * forward_flops(configuration(320))
    with capsys.disabled():
        print(
            f"\n| {torch.cuda.get_device_name()} | ms | reference, ms | ratio |\n|---|---|---|---|"
        )
        for row in (step, average, warp):
            print(f"| {row.case} | {row.ours_ms:.3g} | {row.reference_ms:.3g} | {row.ratio:.3g} |")
        achieved = flops / step.ours_ms / 1e9
        peaks = [peak for name, peak in PEAK_TFLOPS.items() if name in torch.cuda.get_device_name()]
        share = f", {100 * achieved / peaks[0]:.0f} % of its peak" if peaks else ""
        print(f"The denoiser's step: {achieved:.3g} TFLOP/s{share}")
    assert step.ratio > 1
    assert average.ratio > 1
    assert average.max_abs_diff < 1e-6


def _compare_warps(gpu: torch.device, batch: PairBatch) -> Timing:
    """On the GPU against the CPU's compiled loops, which batches would be sent from otherwise."""
    bare = [PairBatch(**(vars(batch.to(device)) | {"warp": None})) for device in (gpu, "cpu")]

    def coverage(batch: PairBatch) -> Tensor:
        warp = compute_warp(batch).warp
        assert warp is not None
        return warp.mask.mean().cpu()

    case = f"warp, batch {_BATCH}, against the CPU's"
    return compare(case, gpu, lambda: coverage(bare[0]), lambda: coverage(bare[1]), repeats=10)
