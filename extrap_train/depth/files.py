"""Depth maps from files that another program has made, brought to the scale of the cameras."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.config import FilesDepthConfig, MonocularConfig
from extrap_train.depth import DepthMap, NoDepthError, PointMaps, point_maps_of
from extrap_train.depth.depth_folder import (
    find_depth_file,
    read_depth_file,
    require_same_camera,
)
from extrap_train.depth.depth_scale import differences, solve_scales
from extrap_train.depth.monocular import MonocularDepth
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import pixel_grid
from extrap_train.geometry.resample import sample_surfaces
from extrap_train.matching import Matcher
from extrap_train.views import Camera, View, stack_poses

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class FilesDepth:
    """Depth by the files of a folder; scale, and shift if asked for, by the known cameras.

    Confidence is that of the files, or 1 where they have none.
    """

    config: FilesDepthConfig
    folder: Path
    matcher: Matcher | None = field(default=None, repr=False, compare=False)
    """For `align="affine"`."""

    @property
    def image_size(self) -> int:
        """Longer side that depth is resampled to, in pixels."""
        return self.config.image_size

    def point_maps(self, first: View, second: View) -> PointMaps:
        """Both views' points in the first camera's frame; InputError if one has no file."""
        one, two = self._aligned([self._require(first), self._require(second)], [first, second])
        return point_maps_of(first, one, second, two)

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        """One view's depth, at the scale that makes it agree with the neighbours'.

        InputError if it has no file.
        """
        known = [(self._require(view), view)]
        known += [(file, other) for other in neighbours if (file := self._find(other)) is not None]
        return self._aligned(*map(list, zip(*known, strict=True)))[0]

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        """Every view's depth; 0, unknown, for views without a file, which one warning names.

        InputError if none has a file, if a file is damaged or of another camera, or if a view's
        depth contradicts the other views'; NoDepthError if the views do not determine the scale.
        """
        files = [self._find(view) for view in views]
        missing = [view for view, file in zip(views, files, strict=True) if file is None]
        if missing and len(missing) == len(views):
            self._require(missing[0])
        if missing:
            LOG.warning(
                "depth=files: %s has no file for %d of %d views, the first is %s",
                *(self.folder, len(missing), len(views), missing[0].name or "a view"),
            )
        known = [(file, view) for file, view in zip(files, views, strict=True) if file is not None]
        found = iter(self._aligned([file for file, _ in known], [view for _, view in known]))
        return [
            DepthMap(*torch.zeros_like(view.image[:2])) if file is None else next(found)
            for file, view in zip(files, views, strict=True)
        ]

    def _find(self, view: View) -> Path | None:
        if view.photograph is None:
            return None
        return find_depth_file(self.folder, view.photograph.path)

    def _require(self, view: View) -> Path:
        file = self._find(view)
        if file is None:
            what = view.photograph.path if view.photograph else "a view that is no photograph"
            raise InputError(
                f"depth.folder={self.folder}: has no depth of {what}; add that file (.npz, "
                ".npy or .png, called like the photograph) or use depth=stereo"
            )
        return file

    def _aligned(self, files: Sequence[Path], views: Sequence[View]) -> list[DepthMap]:
        """The views' depth in their own world, checked against each other."""
        extent = _extent([view.photograph.camera for view in views if view.photograph])
        maps = [_read(file, view, extent) for file, view in zip(files, views, strict=True)]
        affine = self.config.align == "affine"
        maps = self._solve_affine(maps, views) if affine else self._solve_scale(maps, views)
        self._check(views, maps)
        return maps

    def _solve_scale(self, maps: Sequence[DepthMap], views: Sequence[View]) -> list[DepthMap]:
        """Depth by one scale for all, or one per view: then 0, unknown, where it is not told."""
        maps = [replace(found, depth=found.depth.clamp_min(0)) for found in maps]
        scales = solve_scales(_reliable(views, maps), per_view=self.config.align == "view")
        known = [scale for scale in scales if scale is not None]
        if not known:
            raise NoDepthError(
                f"depth=files: {len(views)} views with files do not determine the scale of their "
                "depth: they see too little in common, or stand too near to each other; give more "
                "photographs (inputs=) or others (input_frames=), or use depth=stereo"
            )
        if without := [view for view, scale in zip(views, scales, strict=True) if scale is None]:
            LOG.warning(
                "depth=files: the scale of %d of %d views cannot be told, the first is %s",
                *(len(without), len(views), without[0].name or "a view"),
            )
        LOG.warning("depth=files: scale %.4g to %.4g by the photographs", min(known), max(known))
        return [
            replace(
                found, depth=found.depth * (scale or 0), confidence=found.confidence * bool(scale)
            )
            for found, scale in zip(maps, scales, strict=True)
        ]

    def _solve_affine(self, maps: Sequence[DepthMap], views: Sequence[View]) -> list[DepthMap]:
        """Depth from inverse depth, each view's scale and shift by matches with other views."""
        assert self.matcher is not None
        network = _Inverse([view.image for view in views], [found.depth for found in maps])
        options = MonocularConfig(matcher=self.config.matcher)
        found = MonocularDepth(options, network, self.matcher).depth_maps(views)
        return [
            replace(solved, confidence=solved.confidence * stored.confidence)
            for solved, stored in zip(found, maps, strict=True)
        ]

    def _check(self, views: Sequence[View], maps: Sequence[DepthMap]) -> None:
        """Log how far the views' depths differ; InputError where that is too far for one view."""
        found = zip(differences(_reliable(views, maps)), views, strict=True)
        measured = sorted(
            (difference, view.name or "a view")
            for difference, view in found
            if difference is not None
        )
        if not measured:
            raise NoDepthError(
                f"depth=files: none of the {len(views)} views with files sees what another one "
                "sees, so that their depth cannot be checked; give photographs nearer to each other"
            )
        most, name = measured[-1]
        if most > self.config.max_residual:
            raise InputError(
                f"{name}: its depth in depth.folder={self.folder} differs from that of "
                f"other views by {most:.1%} (median), more than depth.max_residual="
                f"{self.config.max_residual}; correct or remove its file, or give depth.align=view "
                "or affine if the files have no common scale"
            )
        LOG.warning(
            "depth=files: depths of %d views differ by %.1f %% (median), at worst by %.1f %% (%s)",
            *(len(measured), 100 * measured[len(measured) // 2][0], 100 * most, name),
        )


def _reliable(views: Sequence[View], maps: Sequence[DepthMap]) -> list[View]:
    return [
        replace(view, depth=found.reliable(), mask=None)
        for view, found in zip(views, maps, strict=True)
    ]


@dataclass(frozen=True)
class _Inverse:
    """Stored inverse depth as the answer of a network to one of these very images."""

    images: Sequence[Float[Tensor, "3 h w"]]
    inverse_depths: Sequence[Float[Tensor, "h w"]]

    @property
    def image_size(self) -> int:
        return max(self.images[0].shape[1:])

    def inverse_depth(self, image: Float[Tensor, "3 h w"]) -> Float[Tensor, "h w"]:
        return next(
            found
            for known, found in zip(self.images, self.inverse_depths, strict=True)
            if known is image
        )


def _read(file: Path, view: View, extent: float) -> DepthMap:
    """The file's values at the view's pixels, in the file's unit."""
    assert view.photograph is not None
    whole, stored = view.photograph.camera, read_depth_file(file)
    require_same_camera(stored, whole, extent)
    own, k = view.camera.intrinsics, whole.intrinsics.to(view.camera.intrinsics)
    grid = pixel_grid(view.camera.height, view.camera.width, own.device).to(own)
    in_photograph = (grid - own[:2, 2]) / own.diagonal()[:2] * k.diagonal()[:2] + k[:2, 2]
    height, width = stored.depth.shape
    pixels = in_photograph * own.new_tensor([width / whole.width, height / whole.height])
    both = torch.stack([stored.depth, stored.confidence]).to(own)
    return DepthMap(*sample_surfaces(both, pixels))


def _extent(cameras: Sequence[Camera]) -> float:
    """Greatest distance of a camera from their middle; of a lone one from the origin."""
    centers = stack_poses(cameras).center
    spread = float((centers - centers.mean(0)).norm(dim=-1).max())
    return spread or float(centers.norm(dim=-1).max())
