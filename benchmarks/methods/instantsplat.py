"""InstantSplat (Fan et al., 2024): a dense start from depth, poses refined with the scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from benchmarks.methods.threedgs import ThreeDgs
from extrap_train.config.options import option
from extrap_train.depth import DepthMap
from extrap_train.gaussians.density import rotation_matrices
from extrap_train.gaussians.init import Points, pixel_points
from extrap_train.gaussians.recipe import Recipe
from extrap_train.gaussians.training_scene import TrainingScene
from extrap_train.geometry.cameras import project, unproject_to_world
from extrap_train.views import Camera, View, combine

_STEADY, _LOOSE = 1.0, 100.0
"""Step of a mean at full confidence, and at none."""


class InstantSplatRecipe(Recipe):
    """Dense points less those seen twice; their confidence and the poses take part."""

    options: "InstantSplat"

    def __init__(self, options: "InstantSplat", scene: TrainingScene) -> None:
        super().__init__(options, scene)
        self._poses = PoseCorrections(len(scene.views)).to(options.device)

    def initial_points(self) -> Points:
        """Every reliable pixel that no better view shows already."""
        views, options = self.scene.views, self.options
        maps = self.scene.depth_maps(self.scene.depth_source)
        wanted = unique_pixels(views, maps, options.covisibility)
        parts = [pixel_points(*each) for each in zip(views, maps, wanted, strict=True)]
        found = combine(parts, torch.cat)
        points = found.at_most(
            min(options.init_points, options.max_gaussians), self.generator
        )  # fmt: skip
        if options.confidence_rates:
            self.means_factor = confidence_factor(points.confidence)[:, None].to(options.device)
        self.scene.record["init"] = f"{len(points)} points of the depth source, seen once"
        refined = "refined with the scene" if options.pose_rate > 0 else "as given"
        self.scene.record["poses"] = f"{refined}; targets moved along, no photograph of them used"
        return points

    def modules(self) -> Sequence[tuple[nn.Module, float, float]]:
        """The poses' corrections."""
        if self.options.pose_rate == 0:
            return ()
        return ((self._poses, self.options.pose_rate, self.options.pose_rate_final),)

    def camera(self, index: int) -> Camera:
        """The input's camera as it is refined so far."""
        return self._poses.corrected(super().camera(index), index)

    @torch.no_grad()
    def target_cameras(self, cameras: Camera) -> Camera:
        """Moved as the input cameras have moved on the whole."""
        refined = [self.camera(index) for index in range(len(self.cameras))]
        return similarity_between(self.cameras, refined).camera(cameras)


@dataclass(frozen=True)
class InstantSplat(ThreeDgs):
    """One point per pixel, no densification, high learning rates, joint pose refinement."""

    recipe = InstantSplatRecipe

    full_iterations: int = 1000
    init: str = "dense"
    init_points: int = 100_000
    max_gaussians: int = 100_000
    sh_degree: int = 0
    means_rate_final: float = 1.372e-4
    """1.6e-4 → 1.6e-6 over 30,000 iterations, of which 1000 are run: 1.6e-4 · 0.01^(1 / 30)."""
    sh_dc_rate: float = 0.025
    log_scales_rate: float = 0.05
    quats_rate: float = 0.01
    densify_until: int = 0
    reset_every: int = 0

    covisibility: float = option(
        0.01, "share of a view's depth range within which surfaces are the same; 0: keep all", low=0
    )
    confidence_rates: bool = option(True, "whether unsure points move faster")
    pose_rate: float = option(1e-4, "learning rate of the input poses; 0: they stay", low=0)
    pose_rate_final: float = option(1e-6, "the same at the end", low=0)


def confidence_factor(confidence: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Step of each mean: 1 + 99 · (1 − sigmoid(c)), c the confidence on DUSt3R's scale.

    DUSt3R's confidences start at 1 and have no end; ours lie in [0, 1], and 1 / (1 − ours) is of
    that kind.
    """
    dust3r = 1 / (1 - confidence.clamp(0, 0.999))
    return _STEADY + (_LOOSE - _STEADY) * (1 - torch.sigmoid(dust3r))


def unique_pixels(
    views: Sequence[View], maps: Sequence[DepthMap], threshold: float
) -> list[Bool[Tensor, "h w"]]:
    """For each view the pixels that no view of higher mean confidence has given a point for.

    A pixel is redundant where the points of the better views, projected into it, have its depth
    within `threshold` of the view's own range of depths.
    """
    confidences = [float(each.confidence.mean()) for each in maps]
    order = sorted(range(len(views)), key=lambda i: (-confidences[i], i))
    unique: list[Bool[Tensor, "h w"]] = [each.reliable() > 0 for each in maps]
    given = torch.zeros(0, 3)
    for index in order:
        camera, depth = views[index].camera, maps[index].depth
        known = unique[index]
        if known.any() and len(given):
            span = depth[known].max() - depth[known].min()
            there = nearest_depth(given, camera)
            same = (there > 0) & ((there - depth).abs() < threshold * span)
            unique[index] = known & ~same
        given = torch.cat([given, unproject_to_world(depth, camera)[unique[index]]])
    return unique


def nearest_depth(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "h w"]:
    """Depth of the nearest point in each pixel; 0 where there is none."""
    pixels, depth = project(points, camera)
    column, row = pixels.floor().long().unbind(-1)
    inside = (depth > 0) & (column >= 0) & (column < camera.width)
    inside = inside & (row >= 0) & (row < camera.height)
    place = (row * camera.width + column)[inside]
    nearest = torch.full((camera.height * camera.width,), torch.inf)
    nearest = nearest.scatter_reduce(0, place, depth[inside], "amin")
    return torch.where(nearest.isfinite(), nearest, 0).reshape(camera.height, camera.width)


class PoseCorrections(nn.Module):
    """A small rigid motion behind each camera's given pose; none at the start."""

    def __init__(self, count: int) -> None:
        super().__init__()
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0])
        self.quats = nn.Parameter(identity.repeat(count, 1))
        self.translations = nn.Parameter(torch.zeros(count, 3))

    def corrected(self, camera: Camera, index: int) -> Camera:
        """The camera with its correction, which turns and shifts its own axes."""
        motion = torch.eye(4).to(self.translations)
        rotation = rotation_matrices(self.quats[index : index + 1])[0]
        top = torch.cat([rotation, self.translations[index][:, None]], 1)
        motion = torch.cat([top, motion[3:]], 0)
        return replace(camera, world_to_cam=motion @ camera.world_to_cam)


@dataclass(frozen=True)
class Similarity:
    """`x_to = scale · rotation · x_from + translation`."""

    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]
    scale: float

    def camera(self, camera: Camera) -> Camera:
        """The camera that sees the moved world as the given one (or batch) sees the old."""
        rotation = camera.world_to_cam[..., :3, :3] @ self.rotation.T
        center = self.scale * camera.center @ self.rotation.T + self.translation
        world_to_cam = camera.world_to_cam.clone()
        world_to_cam[..., :3, :3] = rotation
        world_to_cam[..., :3, 3] = -(rotation @ center[..., None])[..., 0]
        return replace(camera, world_to_cam=world_to_cam)


def similarity_between(given: Sequence[Camera], refined: Sequence[Camera]) -> Similarity:
    """The motion of the whole world that explains best how the cameras moved.

    The rotation is the mean of the cameras' own (centres alone leave it open for views in a row),
    then scale and translation fit the centres by least squares.
    """
    turns = [
        b.world_to_cam[:3, :3].T @ a.world_to_cam[:3, :3]
        for a, b in zip(given, refined, strict=True)
    ]
    rotation = roma.special_procrustes(torch.stack(turns).double().sum(0)).to(turns[0])
    source = torch.stack([camera.center for camera in given]) @ rotation.T
    target = torch.stack([camera.center for camera in refined])
    a, b = source - source.mean(0), target - target.mean(0)
    scale = float((a * b).sum() / a.square().sum().clamp_min(1e-20)) if a.any() else 1.0
    return Similarity(rotation, target.mean(0) - scale * source.mean(0), scale)
