"""A whole training step at the full size's make, from the stored frames to the averaged weights.

Ours reads what the product stores and computes as its training does: compressed frames, cached
features, the compiled warp, mixed precision, fused optimiser and average. The reference is the same
written plainly: PNG files and arrays, every network in every step, the warp in torch, float32, an
optimiser and an average with a function per tensor. Neither has loaders beside the process.
"""

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float16, UInt8
from PIL import Image
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_avg_fn

from benchmarks.perf.diffusion_case import Run, configuration, optimised, plain
from benchmarks.perf.timing import Timing, compare, devices
from benchmarks.perf.train_timing import training_step
from data_prep.category_pairs import prepare_category
from data_prep.frame_features import encode_with
from extrap_train.config import (
    DatasetDepthConfig,
    FlowMatcherConfig,
    ModelConfig,
    PrepConfig,
    SyntheticConfig,
)
from extrap_train.data.examples import ExampleReader
from extrap_train.data.module import TrainingBatches
from extrap_train.data.prepared import PreparedData
from extrap_train.diffusion.averaging import AveragedModule
from extrap_train.diffusion.frozen_features import frame_encoder
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.geometry.resample import reduce_batch
from extrap_train.geometry.warp import compute_warp, draw_torch, warp_of_means
from extrap_train.views import PairBatch

_BATCH = 4
"""As the paper trains."""
_DECAY = 0.999
_FAMILIES = ("ours", "zeronvs")
_WIDTHS = {"cpu": 96, "cuda": 320}
_REPEATS = {"cpu": 3, "cuda": 15}


def run() -> list[Timing]:
    """One row per family and device; on a CPU in milliseconds of its cores."""
    with tempfile.TemporaryDirectory() as folder:
        data = prepared_captures(Path(folder), configuration(_WIDTHS["cpu"]).warp_size)
        return [
            compare_steps(
                configuration(_WIDTHS[device.type], family), data, device, _REPEATS[device.type]
            )
            for device in devices()
            for family in _FAMILIES
        ]


def compare_steps(
    config: ModelConfig, data: PreparedData, device: torch.device, repeats: int
) -> Timing:
    """The row of one model; the first steps of both start from the same weights."""
    model = optimised(config, device)
    encode_with(model, [data])
    theirs = _plain_step(plain(model), _PlainFrames.write(data), device)
    ours = _our_step(model, data, device)
    clock = time.process_time if device.type == "cpu" else time.perf_counter
    case = f"{config.family}, end to end, batch {_BATCH}"
    return compare(case, device, ours, theirs, repeats, clock)


def prepared_captures(folder: Path, size: int) -> PreparedData:
    """Rendered captures with their depth, as a training prepares them."""
    return prepare_category(
        "hydrant",
        SyntheticConfig(test_sequences=1, train_sequences=1, frames=6, image_size=size),
        DatasetDepthConfig(),
        PrepConfig(image_size=size, full_circle="ignore"),
        output=folder,
        workers=1,
        matcher=FlowMatcherConfig(),
    )


class _PlainFrames(PreparedData):
    """The same frames as PNG files and arrays."""

    @classmethod
    def write(cls, data: PreparedData) -> "_PlainFrames":
        """Write the frames of the training sequences beside what is prepared."""
        for sequence in data.pairs("train").sequence:
            (data.folder / sequence).mkdir(parents=True, exist_ok=True)
            for index in range(len(data.names(sequence))):
                file = data.folder / sequence / f"{index}.png"
                if not file.exists():
                    image = data.images(sequence, [index])[0].permute(1, 2, 0)
                    Image.fromarray(image.numpy()).save(file)
                    np.save(file.with_suffix(".npy"), data.depths(sequence, [index])[0].numpy())
        opened = cls.open(data.folder)
        assert isinstance(opened, cls)
        return opened

    def images(self, sequence: str, indices: Sequence[int]) -> UInt8[Tensor, "k 3 h w"]:
        """See `PreparedData.images`."""
        files = [self.folder / sequence / f"{index}.png" for index in indices]
        pictures = [torch.from_numpy(np.array(Image.open(file))) for file in files]
        return torch.stack(pictures).permute(0, 3, 1, 2).contiguous()

    def depths(self, sequence: str, indices: Sequence[int]) -> Float16[Tensor, "k h w"]:
        """See `PreparedData.depths`."""
        files = [self.folder / sequence / f"{index}.npy" for index in indices]
        return torch.stack([torch.from_numpy(np.load(file)) for file in files])


def _our_step(model: ExtrapolationModel, data: PreparedData, device: torch.device) -> Run:
    references = model.config.references
    reader = ExampleReader([data], "train", references, frame_encoder(model))
    average = AveragedModule(model, device, _DECAY)

    def warped(batch: PairBatch) -> PairBatch:
        return compute_warp(batch, model.config.image_size)

    return _whole_step(model, reader, device, warped, average, optimised=True)


def _plain_step(model: ExtrapolationModel, data: PreparedData, device: torch.device) -> Run:
    reader = ExampleReader([data], "train", model.config.references)
    average = AveragedModel(model, avg_fn=get_ema_avg_fn(_DECAY), use_buffers=True)

    def warped(batch: PairBatch) -> PairBatch:
        valid = batch.reference_valid[..., None, None]
        depths = torch.where(valid, batch.reference_depths, 0)
        images, cameras = batch.reference_images, batch.reference_cameras
        means = draw_torch(images, depths, cameras, batch.camera, batch.reference_flows)
        whole = replace(batch, warp=warp_of_means(means))
        return reduce_batch(whole, batch.camera.height // model.config.image_size)

    return _whole_step(model, reader, device, warped, average, optimised=False)


def _whole_step(
    model: ExtrapolationModel,
    reader: ExampleReader,
    device: torch.device,
    warped: Callable[[PairBatch], PairBatch],
    average: AveragedModel,
    *,
    optimised: bool,
) -> Run:
    batches, starts = TrainingBatches(reader, seed=0), count(0, _BATCH)

    def next_batch() -> PairBatch:
        start = next(starts)
        positions = [(p, p % len(reader)) for p in range(start, start + _BATCH)]
        return warped(batches[positions].to(device).unpack())

    train = training_step(model, next_batch, optimised=optimised)

    def step() -> Float[Tensor, ""]:
        loss = train()
        average.update_parameters(model)
        return loss

    return step
