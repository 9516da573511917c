"""A query view and its references: read from prepared data, or posed views and a new camera."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor
from torch.utils.data import default_collate

from extrap_train.data.camera_check import is_degenerate
from extrap_train.data.feature_files import FeatureFiles, FrameEncoder
from extrap_train.data.prepared import PreparedData
from extrap_train.depth import require_depth
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import (
    extra_references,
    pairwise_angles,
    references_by_nearness,
    scene_center,
)
from extrap_train.views import (
    Camera,
    FrameFeatures,
    PackedBatch,
    PairBatch,
    View,
    ViewPair,
    combine,
    stack_cameras,
)

Part = TypeVar("Part")
_DEGENERATE = (
    "its camera is degenerate (NaN, no rotation, or a focal length that is not positive); correct "
    "the pose"
)


@dataclass(frozen=True)
class Example:
    """A query and one to `k` references, nearest first.

    Colours are in [0, 1], or bytes, as frames are stored, and depth then in units of `depth_unit`.
    """

    image: Shaped[Tensor, "3 h w"] | None
    """None where `features` stand for it."""
    camera: Camera
    reference_images: Shaped[Tensor, "k 3 h w"]
    reference_cameras: Camera
    reference_depths: Float[Tensor, "k h w"]
    reference_flows: Float[Tensor, "k 2 g g"] | None = None
    depth_unit: float = 1.0
    object_mask: Bool[Tensor, "h w"] | None = None
    """Where the query shows the object; known in held-out examples only."""
    features: FrameFeatures | None = None
    """Of both orientations: as the example is, and in a mirror."""


def mirror(example: Example) -> Example:
    """The example in a mirror: left and right exchanged in images, cameras and world alike."""
    flows, flip = example.reference_flows, torch.tensor([-1.0, 1.0])[:, None, None]
    return replace(
        example,
        image=None if example.image is None else _mirror_pictures(example.image),
        camera=_mirror_camera(example.camera),
        reference_images=_mirror_pictures(example.reference_images),
        reference_cameras=_mirror_camera(example.reference_cameras),
        reference_depths=_mirror_pictures(example.reference_depths),
        reference_flows=None if flows is None else flows.flip(-1) * flip,
        object_mask=None if example.object_mask is None else example.object_mask.flip(-1),
        features=combine([example.features], lambda both: both[0].flip(0)),
    )


def _mirror_pictures(pictures: Shaped[Tensor, "*n h w"]) -> Shaped[Tensor, "*n h w"]:
    """`pictures.flip(-1)`, ten times as fast for bytes."""
    height, width = pictures.shape[-2:]
    rows = pictures.contiguous().view(-1, width)
    kind = {1: torch.uint8, 2: torch.int16, 4: torch.int32}[pictures.element_size()]
    flipped = torch.from_numpy(cv2.flip(rows.view(kind).numpy(), 1))
    return flipped.view(pictures.dtype).view(*pictures.shape[:-2], height, width)


def _mirror_camera(camera: Camera) -> Camera:
    """Reflect the world and the camera along x: the product of both keeps the rotation proper."""
    mirror = torch.diag(camera.world_to_cam.new_tensor([-1.0, 1.0, 1.0, 1.0]))
    intrinsics = camera.intrinsics.clone()
    intrinsics[..., 0, 2] = camera.width - intrinsics[..., 0, 2]
    return replace(
        camera, world_to_cam=mirror @ camera.world_to_cam @ mirror, intrinsics=intrinsics
    )


def collate(examples: Sequence[Example], references: int) -> PairBatch:
    """A batch with room for `references`; missing ones are the first again, marked invalid."""
    return PairBatch(**_stack(examples, references))


def pack(examples: Sequence[Example], references: int) -> PackedBatch:
    """`collate` for examples as they are stored."""
    units = torch.tensor([example.depth_unit for example in examples])
    return PackedBatch(**_stack(examples, references), depth_unit=units)


def _stack(examples: Sequence[Example], references: int) -> dict[str, Any]:
    orders = [
        [i if i < len(e.reference_images) else 0 for i in range(references)] for e in examples
    ]
    valid = [[i < len(e.reference_images) for i in range(references)] for e in examples]
    pairs = list(zip(examples, orders, strict=True))
    return {
        "image": _stack_known([e.image for e in examples]),
        "camera": stack_cameras([e.camera for e in examples]),
        "reference_images": _gather([e.reference_images for e in examples], orders),
        "reference_cameras": stack_cameras(
            [e.reference_cameras[torch.tensor(o)] for e, o in pairs]
        ),
        "reference_depths": _gather([e.reference_depths for e in examples], orders),
        "reference_valid": torch.tensor(valid),
        "reference_flows": _flows([(e.reference_flows, o) for e, o in pairs]),
        "object_mask": _stack_known([e.object_mask for e in examples]),
        "features": _stack_known(
            [combine([e.features], lambda both: both[0][0]) for e in examples]
        ),
    }


def _stack_known(values: Sequence[Part | None]) -> Part | None:
    """The examples' values as one; None where one of them has none."""
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return None
    return combine(known, lambda tensors: torch.stack(list(tensors)))


def _gather(
    parts: Sequence[Shaped[Tensor, "_ *c h w"]], orders: Sequence[Sequence[int]]
) -> Shaped[Tensor, "b k *c h w"]:
    """The chosen pictures of every example, each copied once."""
    chosen = [part[i] for part, order in zip(parts, orders, strict=True) for i in order]
    # In a worker, torch's function writes to memory that it shares with the training process.
    return default_collate(chosen).unflatten(0, (len(parts), -1))


def _flows(
    chosen: Sequence[tuple[Float[Tensor, "_ 2 g g"] | None, list[int]]],
) -> Float[Tensor, "b k 2 g g"] | None:
    """None where no example has any; those of examples without are zero."""
    known = [flows for flows, _ in chosen if flows is not None]
    if not known:
        return None
    none = torch.zeros(len(chosen[0][1]), *known[0].shape[1:])
    return torch.stack([none if flows is None else flows[order] for flows, order in chosen])


def query_batch(
    references: Sequence[View], queries: Camera, most_references: int, size: int
) -> tuple[PairBatch, list[tuple[int, ...]]]:
    """The batch of some queries (batched once), each with its nearest views as references.

    Views and cameras are cropped to centred squares of `size` pixels. The batch's `image`, the
    truth, is NaN; beside it, the indices of every query's references, nearest first. Raises
    InputError where a pose is degenerate or a view has no depth.
    """
    if not references:
        raise InputError("there is no view to start from; give at least one posed photograph")
    for view in references:
        if is_degenerate(view.camera):
            raise InputError(f"view {view.name}: {_DEGENERATE}")
    for index in is_degenerate(queries).nonzero().flatten().tolist():
        raise InputError(f"query {index}: {_DEGENERATE}")
    squares = [
        view if (view.camera.height, view.camera.width) == (size, size) else view.squared(size)
        for view in references
    ]
    cameras = stack_cameras([view.camera for view in squares])
    order = references_by_nearness(cameras, queries)[:, :most_references]
    images = torch.stack([view.image for view in squares])
    depths = torch.stack([require_depth(view) for view in squares])
    square_queries = queries.squared(size)
    unknown = torch.full((3, size, size), torch.nan)
    examples = [
        Example(unknown, square_queries[i], images[chosen], cameras[chosen], depths[chosen])
        for i, chosen in enumerate(torch.from_numpy(order))
    ]
    return collate(examples, most_references), [tuple(row) for row in order.tolist()]


def read_example(
    data: PreparedData,
    pair: ViewPair,
    is_corrected: bool,
    cached: FeatureFiles | None = None,
) -> Example:
    """The pair's example, as stored, with all its references, and their flows if `is_corrected`.

    With `cached` features, which stand for it, the query's photograph is not read.
    """
    sequence, query, references = pair.sequence, pair.query, list(pair.references)
    cameras = data.cameras(sequence)
    return Example(
        None if cached else data.images(sequence, [query])[0],
        cameras[query],
        data.images(sequence, references),
        cameras[torch.tensor(references)],
        data.depths(sequence, references),
        data.flows(sequence, references, query) if is_corrected else None,
        data.depth_unit(sequence),
        features=cached.read(sequence, query, references[0]) if cached else None,
    )


def linspace_indices(available: int, wanted: int) -> list[int]:
    """At most `wanted` indices, spread evenly over `available` places."""
    count = min(available, wanted)
    return torch.linspace(0, available - 1, count).round().long().tolist() if count else []


class ExampleReader:
    """Examples of one split of one or several prepared categories."""

    def __init__(
        self,
        prepared: list[PreparedData],
        split: str,
        references: int,
        encoder: FrameEncoder | None = None,
    ) -> None:
        """With an `encoder`, examples have its cached features instead of their target."""
        self.references = references
        self._arguments = (prepared, split, references, encoder)
        self._prepared, self._split = prepared, split
        self._cached = [FeatureFiles(data, encoder) if encoder else None for data in prepared]
        self._pairs = [data.pairs(split) for data in prepared]
        self._ends = [*accumulate(len(pairs) for pairs in self._pairs)]
        self._angles: dict[tuple[Path, str], np.ndarray] = {}

    def __len__(self) -> int:
        return self._ends[-1]

    def __reduce__(self) -> tuple[type["ExampleReader"], tuple[Any, ...]]:
        """Another process opens the data itself, instead of being sent a million pairs."""
        return ExampleReader, self._arguments

    def _member(self, index: int) -> int:
        return bisect_right(self._ends, index)

    def _pair(self, index: int) -> tuple[PreparedData, ViewPair]:
        member = self._member(index)
        first = self._ends[member - 1] if member else 0
        return self._prepared[member], self._pairs[member][index - first]

    def name(self, index: int) -> str:
        """Unique name of a pair: folder, sequence, query and reference."""
        data, pair = self._pair(index)
        return f"{data.folder.name}/{pair.sequence}/{pair.query}-{pair.references[0]}"

    def angle_rad(self, index: int) -> float:
        """Angle between the query and its nearest reference, seen from the scene's centre."""
        data, pair = self._pair(index)
        return float(self._angles_of(data, pair.sequence)[pair.query, pair.references[0]])

    def read(self, index: int, count: int, rng: np.random.Generator) -> Example:
        """The pair's example with up to `count` references; those after the first are drawn."""
        data, pair = self._pair(index)
        is_corrected = self._split == "train" and data.is_corrected
        # With correction, only frames whose correction for this query is known can be references.
        candidates = (
            data.partners(pair.sequence, pair.query)
            if is_corrected
            else data.reference_frames(pair.sequence)
        )
        first, angles = pair.references[0], self._angles_of(data, pair.sequence)
        further = extra_references(angles, pair.query, first, count, rng, candidates)
        pair = replace(pair, references=(first, *further))
        example = read_example(data, pair, is_corrected, self._cached[self._member(index)])
        if self._split == "train":
            return example
        return replace(example, object_mask=data.mask(pair.sequence, pair.query))

    def pack(self, examples: list[Example]) -> PackedBatch:
        """A batch with room for the reader's number of references."""
        return pack(examples, self.references)

    def _angles_of(self, data: PreparedData, sequence: str) -> np.ndarray:
        key = (data.folder, sequence)  # no `id`: it means nothing in a worker process
        if key not in self._angles:
            cameras = data.cameras(sequence)
            self._angles[key] = pairwise_angles(cameras, scene_center(cameras))
        return self._angles[key]
