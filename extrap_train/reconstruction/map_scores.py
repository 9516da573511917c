"""Numbers about a completed map: drift, consistency between views, coverage, 3-D scores."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import torch

from extrap_train.data.synthetic import DENSE_POINTS, SyntheticScene, surface_points
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.geometry.viewpoints import directions_from, scene_center
from extrap_train.metrics import psnr
from extrap_train.reconstruction.cloud import PointCloud
from extrap_train.reconstruction.cloud_metrics import (
    TOLERANCE,
    CloudScores,
    score_cloud,
    sphere_coverage,
)
from extrap_train.reconstruction.completion import Step
from extrap_train.reconstruction.global_map import GENERATED, GlobalMap, prior_of

SEEN_WITHIN_RAD = np.radians(20)
"""A direction is covered if a view looks from less than this beside it."""


def cloud_scores(
    clouds: dict[str, PointCloud], scene: SyntheticScene, world: WorldFrame
) -> dict[str, dict[str, float]]:
    """3-D scores of some clouds (in the map's world) of a synthetic scene, by name."""
    truth = surface_points(scene, DENSE_POINTS)
    target, around = truth.points[truth.is_object], truth.points[~truth.is_object]
    size = float((target.max(0) - target.min(0)).max())
    scores: dict[str, dict[str, float]] = {}
    for name, cloud in clouds.items():
        points = cloud.points.double().numpy() * world.unit + world.center.double().numpy()
        found: CloudScores = score_cloud(points, target, around, TOLERANCE * size)
        scores[name] = asdict(found)
    return scores


def drift(steps: Sequence[Step], scene_map: GlobalMap) -> dict[str, float | int | None]:
    """Where branches met: the largest of their errors, as a share of the scene's size.

    That is the median width of the pictures at the scene's centre, in scene units.
    """
    errors = [step.loop_error for step in steps if step.loop_error is not None]
    center = torch.from_numpy(scene_center(scene_map.cameras)).float()
    cameras = scene_map.cameras
    z = cameras.world_to_cam[:, 2, :3] @ center + cameras.world_to_cam[:, 2, 3]
    size = float((z * cameras.width / cameras.intrinsics[:, 0, 0]).median())
    return {
        "meetings": len(errors),
        "largest_error": max(errors) / size if errors else None,
        "scene_size": size,
    }


def view_consistency(scene_map: GlobalMap) -> float | None:
    """Mean PSNR (dB) of generated views against their nearest generated view warped onto them,
    over the pixels that it reaches; None with fewer than two.
    """
    generated = [i for i, view in enumerate(scene_map.views) if view.origin.kind == GENERATED]
    values = []
    for index in generated:
        view = scene_map.views[index]
        near = [
            i
            for i in scene_map.nearest(view.camera, len(scene_map))
            if i in generated and i != index
        ]
        if not near:
            return None
        seen = prior_of(scene_map, view.camera, near[:1])
        mask = seen.mask.to(seen.depth.dtype)[None]
        if mask.any():
            values.append(float(psnr(view.view.image[None], seen.image[None], mask)))
    return float(np.mean(values)) if values else None


def coverage_of(scene_map: GlobalMap) -> dict[str, float]:
    """Share of the sphere of viewing directions that views stand within 20° of."""
    directions = directions_from(scene_map.cameras, scene_center(scene_map.cameras))
    given = np.array([v.origin.kind != GENERATED for v in scene_map.views])
    return {
        "inputs": sphere_coverage(directions[given], float(SEEN_WITHIN_RAD)),
        "completed": sphere_coverage(directions, float(SEEN_WITHIN_RAD)),
    }
