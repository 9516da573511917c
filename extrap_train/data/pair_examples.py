"""One training example: a query frame and its references, read from prepared data."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.data.prepared import PreparedData
from extrap_train.geometry.viewpoints import extra_references, pairwise_angles, scene_center
from extrap_train.views import Camera, PairBatch, ViewPair, stack_cameras


@dataclass(frozen=True)
class Example:
    """A query and one to `k` references, nearest first."""

    image: Float[Tensor, "3 h w"]
    camera: Camera
    reference_images: Float[Tensor, "k 3 h w"]
    reference_cameras: Camera
    reference_depths: Float[Tensor, "k h w"]
    reference_flows: Float[Tensor, "k 2 g g"] | None = None


def mirror(example: Example) -> Example:
    """The example in a mirror: left and right exchanged in images, cameras and world alike."""
    return Example(
        example.image.flip(-1),
        _mirror_camera(example.camera),
        example.reference_images.flip(-1),
        _mirror_camera(example.reference_cameras),
        example.reference_depths.flip(-1),
        None if example.reference_flows is None else _mirror_flows(example.reference_flows),
    )


def _mirror_flows(flows: Float[Tensor, "k 2 g g"]) -> Float[Tensor, "k 2 g g"]:
    return flows.flip(-1) * flows.new_tensor([-1.0, 1.0])[:, None, None]


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
    orders = [
        [i if i < len(e.reference_images) else 0 for i in range(references)] for e in examples
    ]
    valid = [[i < len(e.reference_images) for i in range(references)] for e in examples]
    pairs = list(zip(examples, orders, strict=True))
    return PairBatch(
        image=torch.stack([e.image for e in examples]),
        camera=stack_cameras([e.camera for e in examples]),
        reference_images=torch.stack([e.reference_images[o] for e, o in pairs]),
        reference_cameras=stack_cameras([e.reference_cameras[torch.tensor(o)] for e, o in pairs]),
        reference_depths=torch.stack([e.reference_depths[o] for e, o in pairs]),
        reference_valid=torch.tensor(valid),
        reference_flows=_flows([(e.reference_flows, o) for e, o in pairs]),
    )


def _flows(
    chosen: Sequence[tuple[Float[Tensor, "_ 2 g g"] | None, list[int]]],
) -> Float[Tensor, "b k 2 g g"] | None:
    """None where no example has any; those of examples without are zero."""
    known = [flows for flows, _ in chosen if flows is not None]
    if not known:
        return None
    none = torch.zeros(len(chosen[0][1]), *known[0].shape[1:])
    return torch.stack([none if flows is None else flows[order] for flows, order in chosen])


def read_example(data: PreparedData, pair: ViewPair, is_corrected: bool) -> Example:
    """The pair's example with all its references, and with their flows if `is_corrected`."""
    frames = [pair.query, *pair.references]
    images, depths, _ = data.frames(pair.sequence, frames)
    cameras = data.cameras(pair.sequence)[torch.tensor(frames)]
    flows = data.flows(pair.sequence, pair.references, pair.query) if is_corrected else None
    return Example(images[0], cameras[0], images[1:], cameras[1:], depths[1:], flows)


def linspace_indices(available: int, wanted: int) -> list[int]:
    """At most `wanted` indices, spread evenly over `available` places."""
    count = min(available, wanted)
    return torch.linspace(0, available - 1, count).round().long().tolist() if count else []


class ExampleReader:
    """Examples of one split of one or several prepared categories."""

    def __init__(self, prepared: list[PreparedData], split: str, references: int) -> None:
        self.references = references
        self._split = split
        self._pairs = [(data, pair) for data in prepared for pair in data.pairs(split)]
        self._angles: dict[tuple[Path, str], np.ndarray] = {}

    def __len__(self) -> int:
        return len(self._pairs)

    def name(self, index: int) -> str:
        """Unique name of a pair: folder, sequence, query and reference."""
        data, pair = self._pairs[index]
        return f"{data.folder.name}/{pair.sequence}/{pair.query}-{pair.references[0]}"

    def angle_rad(self, index: int) -> float:
        """Angle between the query and its nearest reference, seen from the scene's centre."""
        data, pair = self._pairs[index]
        return float(self._angles_of(data, pair.sequence)[pair.query, pair.references[0]])

    def read(self, index: int, count: int, rng: np.random.Generator) -> Example:
        """The pair's example with up to `count` references; those after the first are drawn."""
        data, pair = self._pairs[index]
        references = self._references(data, pair, count, rng)
        return read_example(data, replace(pair, references=references), self._is_corrected(data))

    def collate(self, examples: list[Example]) -> PairBatch:
        """A batch with room for the reader's number of references."""
        return collate(examples, self.references)

    def _references(
        self, data: PreparedData, pair: ViewPair, count: int, rng: np.random.Generator
    ) -> tuple[int, ...]:
        """Frames that the pair's query is seen from, nearest first; the pair's own is the first."""
        first = pair.references[0]
        angles = self._angles_of(data, pair.sequence)
        candidates = self._candidates(data, pair.sequence, pair.query)
        return (first, *extra_references(angles, pair.query, first, count, rng, candidates))

    def _candidates(self, data: PreparedData, sequence: str, query: int) -> np.ndarray:
        """Frames that it may be seen from: those whose correction is known, where there is one."""
        if self._is_corrected(data):
            return data.partners(sequence, query)
        return data.reference_frames(sequence)

    def _is_corrected(self, data: PreparedData) -> bool:
        return self._split == "train" and data.is_corrected

    def _angles_of(self, data: PreparedData, sequence: str) -> np.ndarray:
        key = (data.folder, sequence)  # no `id`: it means nothing in a worker process
        if key not in self._angles:
            cameras = data.cameras(sequence)
            self._angles[key] = pairwise_angles(cameras, scene_center(cameras))
        return self._angles[key]
