"""How much of a held-out view could be known at all: the warp and the baseline against oracles that
know the truth in one part of the picture after the other. Run with `-s` for the table.
"""

from pathlib import Path

import pytest
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from data_prep.category_pairs import prepare_category
from extrap_train.config import DatasetDepthConfig, FlowMatcherConfig, PrepConfig, SyntheticConfig
from extrap_train.data.co3d import read_category
from extrap_train.data.examples import ExampleReader, linspace_indices
from extrap_train.data.module import ValidationBatches
from extrap_train.data.square_frames import object_square
from extrap_train.diffusion.evaluation import mean_filled_warp
from extrap_train.geometry.warp import compute_warp
from extrap_train.metrics import psnr, quantised
from extrap_train.views import PairBatch

_SIZE, _VIEWS, _REFERENCES = 64, 60, 3
_FAR = 1.8
"""Depths over the object's from which on a pixel belongs to the surroundings, not to the ground."""


def _held_out(output: Path) -> tuple[PairBatch, Bool[Tensor, "b 1 h w"], Bool[Tensor, "b 1 h w"]]:
    """The held-out hydrant views of the first command, with their object and what lies far."""
    data = SyntheticConfig(train_sequences=1)
    prepared = prepare_category(
        "hydrant",
        data,
        DatasetDepthConfig(),
        PrepConfig(),
        output=output,
        workers=2,
        matcher=FlowMatcherConfig(),
    )
    reader, pairs = ExampleReader([prepared], "test", _REFERENCES), prepared.pairs("test")
    chosen = linspace_indices(len(reader), _VIEWS)
    batch = compute_warp(ValidationBatches(reader, chosen, _VIEWS)[0].unpack(), _SIZE)
    captures = {s.name: s for s in read_category(output / "synthetic", "hydrant")}
    frames = [
        captures[pairs[i].sequence.split("/")[1]].frames[pairs[i].query].load() for i in chosen
    ]
    truths = [object_square(frame, PrepConfig().image_size) for frame in frames]
    depth = functional.avg_pool2d(torch.stack([truth.depth for truth in truths])[:, None], 2)
    mask = functional.avg_pool2d(torch.stack([truth.mask for truth in truths])[:, None], 2) > 0.5
    middles = torch.stack([d[m].median() for d, m in zip(depth, mask, strict=True)])
    return batch, mask, depth > _FAR * middles[:, None, None, None]


def _decibels(image: Float[Tensor, "b 3 h w"], truth: Float[Tensor, "b 3 h w"]) -> float:
    return float(psnr(quantised(image), quantised(truth)).mean())


@pytest.mark.slow
def test_objects_and_grounds_leave_a_model_room_above_the_baselines(
    tmp_path: Path,
) -> None:
    batch, is_object, is_far = _held_out(tmp_path)
    assert batch.warp is not None
    truth, known = batch.image, batch.warp.mask[:, None] > 0
    guess = mean_filled_warp(batch.warp)
    blocks = functional.interpolate(functional.avg_pool2d(truth, 16), scale_factor=16)
    unseen = ~known & ~is_object
    knows = {
        "nothing: the warp, holes in the mean colour": torch.zeros_like(known),
        "what the warp shows": known,
        "the object": is_object,
        "the object and what the warp shows": known | is_object,
        "all but the unseen surroundings": ~(unseen & is_far),
    }
    reached = {name: _decibels(torch.where(k, truth, guess), truth) for name, k in knows.items()}
    reached["nothing, but unseen background in its own 16 px means"] = _decibels(
        torch.where(unseen, blocks, guess), truth
    )
    share = float((unseen & is_far).float().mean())
    print(f"\nunseen surroundings: {share:.0%} of the pixels")
    for name, decibels in reached.items():
        print(f"an oracle that knows {name}: {decibels:.2f} dB")
    baseline = reached["nothing: the warp, holes in the mean colour"]
    assert baseline < reached["what the warp shows"] < reached["all but the unseen surroundings"]
    # Else the comparison would be about guessing where unseen houses stand.
    assert reached["all but the unseen surroundings"] - baseline > 2.5
