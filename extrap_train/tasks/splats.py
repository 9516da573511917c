"""`splats.ply`: the Gaussians of a completed scene's views, fitted once and used again."""

import hashlib
import json
import time
from dataclasses import asdict, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.config import SplatsConfig
from extrap_train.depth import DatasetDepth
from extrap_train.errors import InputError
from extrap_train.figures import draw_contact_sheet, error_map
from extrap_train.gaussians.fit import fit_views
from extrap_train.gaussians.gaussian_model import Gaussians
from extrap_train.gaussians.gaussian_options import BACKGROUNDS, GaussianOptions
from extrap_train.gaussians.ply import read_comments, read_splats, write_splats
from extrap_train.gaussians.rasterize import draw, rasterizer
from extrap_train.gaussians.spz import write_spz
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.metrics import psnr, quantised
from extrap_train.reconstruction.global_map import GlobalMap
from extrap_train.views import View


def write_fitted_splats(
    scene_map: GlobalMap, world: WorldFrame, options: SplatsConfig, seed: int, folder: Path
) -> dict[str, float]:
    """Fit 3DGS to all views of the map, in the photographs' world, from the views' own depth.

    A file that was fitted to the very same is used again. Writes `splats.ply`, `splats.spz` if it
    is asked for and, read back and drawn, `splats.png`; returns the number of Gaussians, the mean
    PSNR in dB of what they show of the views, and the seconds that fitting took (0: used again).
    `Diverged` where fitting fails.
    """
    views = [_outside(each.view, world) for each in scene_map.views]
    gaussian_options = GaussianOptions(
        iterations=options.iterations,
        init="dense",
        init_points=options.count,
        max_gaussians=options.count,
    )
    path, mark = folder / "splats.ply", _mark(views, gaussian_options, seed)
    started = time.perf_counter()
    fresh = not _is_marked(path, mark)
    if fresh:
        fitted = fit_views(views, DatasetDepth(), gaussian_options, seed)
        write_splats(path, fitted.gaussians(), comments=[mark])
    spz = folder / "splats.spz"
    if options.spz:
        write_spz(path, spz)
    elif fresh:
        spz.unlink(missing_ok=True)  # it held the Gaussians of before
    seconds = time.perf_counter() - started if fresh else 0.0
    splats = read_splats(path)
    truth = torch.stack([view.image for view in views])
    drawn = quantised(_draw_views(_inside(splats, world), scene_map, gaussian_options))
    draw_contact_sheet(
        {"view": truth, "splats": drawn, "error": error_map(drawn, truth)}, folder / "splats.png"
    )
    score = float(psnr(drawn, truth).mean())
    return {"gaussians": float(len(splats)), "psnr": score, "seconds": seconds}


def _outside(view: View, world: WorldFrame) -> View:
    """A view of the map in the photographs' world."""
    assert view.depth is not None
    return replace(view, camera=world.outside(view.camera), depth=view.depth * world.unit)


def _mark(views: list[View], options: GaussianOptions, seed: int) -> str:
    """Names everything that decides the Gaussians, but for the code."""
    content = hashlib.sha256(json.dumps([asdict(options), seed]).encode())
    for view in views:
        assert view.depth is not None
        tensors = (view.image, view.depth, view.camera.world_to_cam, view.camera.intrinsics)
        for tensor in tensors:
            content.update(tensor.numpy().tobytes())
    return f"fitted to {len(views)} views, sha256 {content.hexdigest()}"


def _is_marked(path: Path, mark: str) -> bool:
    try:
        return mark in read_comments(path)
    except InputError:  # not there, or cut off: fitted anew
        return False


def _inside(splats: Gaussians, world: WorldFrame) -> Gaussians:
    """Gaussians of the photographs' world in the map's, whose unit suits the near plane."""
    means = (splats.means - world.center.to(splats.means)) / world.unit
    return replace(splats, means=means, scales=splats.scales / world.unit)


@torch.no_grad()
def _draw_views(
    splats: Gaussians, scene_map: GlobalMap, options: GaussianOptions
) -> Float[Tensor, "n 3 h w"]:
    rasterize, behind = rasterizer(options.rasterizer), BACKGROUNDS[options.background]
    cameras = [view.camera for view in scene_map.views]
    drawn = [draw(rasterize, splats, camera, behind, options.sh_degree) for camera in cameras]
    return torch.stack([each.image for each in drawn]).clamp(0, 1)
