"""The map's points: each surface once, with colour, normal and a confidence from all views."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn import functional

from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.geometry.warp.surface import normals_from_depth
from extrap_train.reconstruction.global_map import MAX_COMPARED, GlobalMap, MapView, Sight, look_up
from extrap_train.views import combine

MAX_STEP = 0.05
"""Relative difference of depth between neighbouring pixels that are still one surface."""


@dataclass(frozen=True)
class PointCloud:
    """Points in the world."""

    points: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]
    """In [0, 1]."""
    normals: Float[Tensor, "n 3"]
    """Unit length, towards the camera that the point is from."""
    confidence: Float[Tensor, " n"]
    """0 to 1."""
    view: Int[Tensor, " n"]
    """Index of the map's view that the point is from."""

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, chosen: Tensor) -> "PointCloud":
        return combine([self], lambda tensors: tensors[0][chosen])


def cloud_of(scene_map: GlobalMap, *, votes: bool = True, subdivide: int = 1) -> PointCloud:
    """All points that the views added, surfaces cut into `subdivide`² points a pixel.

    With `votes`, points that more certain views have looked through are left out, and the
    confidence of the others is that of the most certain view that shows them, times the share
    that agrees.
    """
    return combine(
        [_points_of(scene_map, index, votes, subdivide) for index in range(len(scene_map))],
        torch.cat,
    )


def _points_of(scene_map: GlobalMap, index: int, votes: bool, subdivide: int) -> PointCloud:
    """A view's fresh points; those at occlusion edges, on no surface, are left out."""
    view = scene_map.views[index]
    normals, on_surface = normals_from_depth(view.depth, view.camera)
    points = unproject_to_world(view.depth, view.camera)
    confidence = view.confidence
    sound = on_surface  # a few surfaces have no normal
    if votes:
        confidence, share = _count_votes(scene_map, index, points.flatten(0, 1))
        confidence, share = confidence.view_as(sound), share.view_as(sound)
        sound = sound & (share >= 0.5)
        confidence = confidence * share
    rotation = view.camera.cam_to_world[:3, :3]
    values = torch.cat(
        [points, view.view.image.permute(1, 2, 0), normals @ rotation.mT, confidence[..., None]], -1
    )
    rows = _subdivide(values, view.fresh & sound, sound, view, subdivide)
    return PointCloud(
        points=rows[:, :3],
        colors=rows[:, 3:6].clamp(0, 1),
        normals=functional.normalize(rows[:, 6:9], dim=-1),
        confidence=rows[:, 9],
        view=torch.full((len(rows),), index),
    )


def _count_votes(
    scene_map: GlobalMap, index: int, points: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Confidence of the most certain view of each point; share of the votes that confirm it."""
    own = scene_map.views[index].confidence.flatten()
    highest, confirmed, contradicted = own, own, torch.zeros_like(own)
    for other_index in scene_map.nearest(scene_map.views[index].camera, MAX_COMPARED + 1):
        if other_index == index:
            continue
        other = scene_map.views[other_index]
        said = look_up(points, other.depth, other.camera, 2 * scene_map.tolerance)
        confidence = other.confidence.flatten()[said.pixel]
        agrees = torch.where(said.sight == Sight.AGREES, confidence, 0)
        highest, confirmed = torch.maximum(highest, agrees), confirmed + agrees
        contradicted = contradicted + torch.where(said.sight == Sight.IN_FRONT, confidence, 0)
    return highest, confirmed / (confirmed + contradicted).clamp(min=1e-6)


def _subdivide(
    values: Float[Tensor, "h w c"],
    kept: Bool[Tensor, "h w"],
    sound: Bool[Tensor, "h w"],
    view: MapView,
    parts: int,
) -> Float[Tensor, "m c"]:
    """The kept pixels' rows, and further ones between four sound neighbours of one surface of which
    at least two are kept: so no seam stays open where one view's points end and another's begin,
    and a lone pixel, often noise, gains no weight.

    Points between are interpolated in the plane of the picture, which on a surface that is nearly
    flat within a pixel is the surface.
    """
    rows = [values[kept]]
    corners, depths = _of_four(values), _of_four(view.depth)
    whole = _of_four(sound).all(0) & (_of_four(kept).sum(0) >= 2)
    whole &= depths.amax(0) < depths.amin(0).clamp(min=1e-30) * (1 + MAX_STEP)
    for down in range(parts):
        for right in range(parts):
            if (down, right) == (0, 0):
                continue
            v, u = down / parts, right / parts
            shares = ((1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u)
            weighted = [s * c[whole] for s, c in zip(shares, corners, strict=True)]
            rows.append(torch.stack(weighted).sum(0))
    return torch.cat(rows)


def _of_four(image: Shaped[Tensor, "h w *c"]) -> Shaped[Tensor, "4 h2 w2 *c"]:
    """What stands at the four corners of every square of neighbouring pixels."""
    return torch.stack([image[:-1, :-1], image[:-1, 1:], image[1:, :-1], image[1:, 1:]])
