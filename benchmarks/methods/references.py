"""Which inputs stand nearest to each target, and their batch: what every warping method needs."""

from collections.abc import Sequence

import torch

from benchmarks.methods.base import SceneInputs
from extrap_train.geometry.viewpoints import nearest_references, pairwise_angles, scene_center
from extrap_train.geometry.warp import warp_references
from extrap_train.views import PairBatch, View, stack_cameras, stack_poses


def nearest_inputs(inputs: SceneInputs, count: int) -> list[list[int]]:
    """For every target the up to `count` inputs nearest by angle about the scene's centre, nearest
    first (METHOD §1). The centre is found from all cameras, which every method is given.
    """
    known = [view.camera for view in inputs.views]
    targets = [inputs.targets[i] for i in range(len(inputs.targets.world_to_cam))]
    cameras = stack_poses([*known, *targets])
    angles = pairwise_angles(cameras, scene_center(cameras))
    rows = angles[len(known) :, : len(known)]
    return [nearest_references(row, count).tolist() for row in rows]


def warped_batch(inputs: SceneInputs, depths: Sequence[torch.Tensor], count: int) -> PairBatch:
    """The targets as a batch with their warps; `image` is unknown and left at zero.

    `depths` is the depth map of every input (0 = unknown).
    """
    chosen = nearest_inputs(inputs, count)
    width = len(chosen[0])
    views: list[list[View]] = [[inputs.views[i] for i in row] for row in chosen]
    targets = inputs.targets
    number = len(chosen)
    images = torch.stack([torch.stack([v.image for v in row]) for row in views])
    maps = torch.stack([torch.stack([depths[i] for i in row]) for row in chosen])
    cameras = stack_cameras([stack_cameras([v.camera for v in row]) for row in views])
    valid = torch.ones(number, width, dtype=torch.bool)
    return PairBatch(
        image=torch.zeros(number, 3, targets.height, targets.width),
        camera=targets,
        reference_images=images,
        reference_cameras=cameras,
        reference_depths=maps,
        reference_valid=valid,
        warp=warp_references(images, maps, cameras, valid, targets),
    )


def input_depths(inputs: SceneInputs) -> list[torch.Tensor]:
    """The inputs' depth maps from the given source, 0 where it is unsure."""
    return [found.reliable() for found in inputs.depth_source.depth_maps(inputs.views)]
