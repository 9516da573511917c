"""Generated views far from every photograph against the truth, the object alone: what a user sees
who walks around it.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from extrap_train.data.synthetic import SyntheticScene, render, surface_points
from extrap_train.diffusion.evaluation import inpainted_warp
from extrap_train.geometry.cameras import WorldFrame, unproject_to_world
from extrap_train.geometry.warp import warp_references
from extrap_train.reconstruction.global_map import GlobalMap
from extrap_train.views import View, stack_cameras

BORDER = 4
"""Pixels around the object that LPIPS sees, too."""

Distance = Callable[[Tensor, Tensor], Tensor]


def score_pictures(
    scene: SyntheticScene, world: WorldFrame, pictures: dict[str, View], lpips: Distance
) -> list[dict[str, str | float]]:
    """PSNR (dB) of the object's pixels and LPIPS of the object before black, of pictures from one
    camera, by name; IoU of the silhouettes of those that have depth.
    """
    camera = next(iter(pictures.values())).camera
    truth = render(scene, world.outside(camera))
    assert truth.mask is not None
    mask = truth.mask > 0.5
    rows, columns = mask.nonzero().T
    box = (
        slice(max(0, int(rows.min()) - BORDER), int(rows.max()) + BORDER),
        slice(max(0, int(columns.min()) - BORDER), int(columns.max()) + BORDER),
    )
    found = []
    for name, view in pictures.items():
        error = (view.image - truth.image)[:, mask].square().mean()
        cut = [(image * mask)[None, :, *box] for image in (view.image, truth.image)]
        silhouette = float("nan")
        if view.depth is not None:
            other = is_object(view, scene, world)
            silhouette = float((other & mask).sum() / (other | mask).sum())
        found.append(
            {
                "picture": name,
                "psnr": float(-10 * error.log10()),
                "lpips": float(lpips(*cut)),
                "silhouette": silhouette,
            }
        )
    return found


def is_object(view: View, scene: SyntheticScene, world: WorldFrame) -> Tensor:
    """Pixels whose point lies in the object's box, 2 % of its size above the ground."""
    truth = surface_points(scene, 20_000)
    target = torch.from_numpy(truth.points[truth.is_object])
    low, high = target.amin(0), target.amax(0)
    size = (high - low).max()
    low, high = low - 0.05 * size, high + 0.05 * size
    low[2] = target[:, 2].min() + 0.02 * size
    assert view.depth is not None
    points = unproject_to_world(view.depth, view.camera).double() * world.unit + world.center
    return (view.depth > 0) & ((points > low) & (points < high)).all(-1)


def pictures_without_model(inputs: GlobalMap, like: View) -> dict[str, View]:
    """The nearest photograph as it is, and the warp of the three nearest with its holes inpainted,
    for the camera of a view.
    """
    nearest = [inputs.views[index].view for index in inputs.nearest(like.camera, 3)]
    depths = torch.stack([view.depth for view in nearest if view.depth is not None])
    warp = warp_references(
        torch.stack([view.image for view in nearest])[None],
        depths[None],
        stack_cameras([stack_cameras([view.camera for view in nearest])]),
        torch.ones(1, len(nearest), dtype=torch.bool),
        stack_cameras([like.camera]),
    )
    return {
        "nearest photograph": View(nearest[0].image, like.camera),
        "inpainted warp": View(inpainted_warp(warp)[0].clamp(0, 1), like.camera),
    }
