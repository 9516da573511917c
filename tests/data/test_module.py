"""Batches are a function of seed and position alone; a mirrored example is a consistent scene."""

import pickle
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from orbits import capture, even, ring
from prepared import prepared_captures

from extrap_train.data.examples import (
    Example,
    ExampleReader,
    collate,
    linspace_indices,
    mirror,
    pack,
)
from extrap_train.data.module import PositionSampler
from extrap_train.geometry.warp import compute_warp
from extrap_train.views import Camera, PairBatch


@given(pairs=st.integers(1, 40), size=st.integers(1, 7), batches=st.integers(1, 9))
@settings(max_examples=30, deadline=None)
def test_every_pass_visits_every_pair_once(pairs: int, size: int, batches: int) -> None:
    seen: list[tuple[int, int]] = []
    sampler = PositionSampler(pairs, size, batches, seed=3, steps_done=lambda: len(seen) // size)
    for _ in range(1 + 2 * pairs // (size * batches)):
        seen += [item for batch in list(sampler) for item in batch]
    assert [position for position, _ in seen] == list(range(len(seen)))
    for start in range(0, len(seen) - pairs + 1, pairs):
        assert sorted(pair for _, pair in seen[start : start + pairs]) == list(range(pairs))


def test_an_epoch_needs_no_history_and_no_length() -> None:
    whole = list(PositionSampler(50, 4, 18, seed=1, steps_done=lambda: 0))
    later = PositionSampler(50, 4, 6, seed=1, steps_done=lambda: 7)
    assert list(later) == whole[7:13]


def test_ranks_share_the_stream_without_overlap() -> None:
    whole = PositionSampler(50, 4, 6, seed=1, steps_done=lambda: 0)
    ranks = [
        PositionSampler(50, 4, 3, seed=1, steps_done=lambda: 0, rank=r, world=2) for r in range(2)
    ]
    both = [list(rank) for rank in ranks]
    together = [batch for pair in zip(*both, strict=True) for batch in pair]
    assert together == list(whole)


def test_a_reader_is_sent_to_workers_as_the_name_of_its_data(tmp_path: Path) -> None:
    """Not as a million pairs; there it reads what it reads here."""
    frames = [capture(ring(even(24)), name, depth=2.5) for name in ("a", "b", "c")]
    folders = [tmp_path / name for name in ("one", "two")]
    reader = ExampleReader([prepared_captures(x, frames, {"c"}) for x in folders], "train", 2)
    sent = pickle.dumps(reader)
    assert len(sent) < 1000
    again = pickle.loads(sent)
    assert len(again) == len(reader) > 0
    for index in (0, len(reader) // 2 - 1, len(reader) // 2, len(reader) - 1):
        assert again.name(index) == reader.name(index)
        assert reader.name(index).startswith(folders[index >= len(reader) // 2].name)
        read = [each.read(index, 2, np.random.default_rng(0)) for each in (reader, again)]
        assert torch.equal(read[0].reference_images, read[1].reference_images)


def test_spread_reaches_both_ends() -> None:
    assert linspace_indices(10, 4) == [0, 3, 6, 9]
    assert linspace_indices(2, 9) == [0, 1]
    assert linspace_indices(0, 3) == []


def _example(batch: PairBatch) -> Example:
    return Example(
        batch.image[0],
        batch.camera[0],
        batch.reference_images[0],
        batch.reference_cameras[0],
        batch.reference_depths[0],
    )


def _batch(example: Example, like: PairBatch) -> PairBatch:
    one = slice(0, 1)
    return replace(
        like,
        image=example.image[None],
        camera=_single(example.camera),
        reference_images=example.reference_images[None],
        reference_cameras=_single(example.reference_cameras),
        reference_depths=example.reference_depths[None],
        reference_valid=like.reference_valid[one],
        warp=None,
    )


def _single(camera: Camera) -> Camera:
    return replace(
        camera, world_to_cam=camera.world_to_cam[None], intrinsics=camera.intrinsics[None]
    )


@pytest.fixture
def wall_batch() -> PairBatch:
    from diffusion.batches import batch_of

    return batch_of(1)


def test_the_warp_of_the_mirror_is_the_mirror_of_the_warp(wall_batch: PairBatch) -> None:
    example = _example(wall_batch)
    plain = compute_warp(_batch(example, wall_batch)).warp
    flipped = compute_warp(_batch(mirror(example), wall_batch)).warp
    assert plain is not None
    assert flipped is not None
    agree = (plain.mask == flipped.mask.flip(-1)).float().mean()
    assert agree > 0.98
    both = (plain.mask * flipped.mask.flip(-1))[:, None]
    difference = ((plain.image - flipped.image.flip(-1)) * both).abs()
    assert float(difference.mean()) < 2e-3


def test_a_packed_batch_is_the_batch_in_fewer_bytes(wall_batch: PairBatch) -> None:
    """Bytes and half precision on the way, single precision where it arrives; of two examples, one
    has a reference less and none of its flows.
    """
    stored, plain = [], []
    for known, unit, flows in ((3, 0.25, torch.ones(3, 2, 4, 4)), (2, 4.0, None)):
        example = _example(wall_batch)
        colours = (example.image * 255).round(), (example.reference_images[:known] * 255).round()
        depths = (example.reference_depths[:known] / unit).half()
        shared = {"reference_cameras": example.reference_cameras[:known], "reference_flows": flows}
        image, references = (x.to(torch.uint8) for x in colours)
        stored.append(
            replace(
                example,
                image=image,
                reference_images=references,
                reference_depths=depths,
                depth_unit=unit,
                **shared,
            )
        )
        image, references = (x / 255 for x in colours)
        plain.append(
            replace(
                example,
                image=image,
                reference_images=references,
                reference_depths=depths.float() * unit,
                **shared,
            )
        )
    packed, batch = pack([mirror(x) for x in stored], 3), collate([mirror(x) for x in plain], 3)
    assert packed.reference_valid.tolist() == [[True, True, True], [True, True, False]]
    assert _bytes_of(packed.to("cpu")) < 0.35 * _bytes_of(batch)
    for ours, expected in zip(_tensors(packed.unpack()), _tensors(batch), strict=True):
        assert torch.equal(ours, expected)


def _tensors(batch: object) -> list[torch.Tensor]:
    found: list[torch.Tensor] = []
    for field in fields(batch):
        value = getattr(batch, field.name)
        if isinstance(value, torch.Tensor):
            found.append(value)
        elif is_dataclass(value):
            found += _tensors(value)
    return found


def _bytes_of(batch: object) -> int:
    return sum(tensor.nbytes for tensor in _tensors(batch))


def test_mirroring_twice_changes_nothing(wall_batch: PairBatch) -> None:
    example = _example(wall_batch)
    again = mirror(mirror(example))
    torch.testing.assert_close(again.camera.world_to_cam, example.camera.world_to_cam)
    torch.testing.assert_close(again.camera.intrinsics, example.camera.intrinsics)
    assert torch.equal(again.image, example.image)
    assert torch.linalg.det(mirror(example).camera.world_to_cam) > 0
