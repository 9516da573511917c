"""Pictures of the cloud: how it grows view by view, and a turn around it (the paper's Fig. 3)."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.figures import draw_contact_sheet, plot_cameras, save_figure, write_film
from extrap_train.geometry.viewpoints import camera_centers, fit_orbit_of_few, scene_center
from extrap_train.geometry.warp import splat_points
from extrap_train.reconstruction.cloud import PointCloud
from extrap_train.reconstruction.global_map import GlobalMap
from extrap_train.reconstruction.planner import Query, circle_cameras
from extrap_train.views import Camera, stack_cameras

PICTURE_SIZE = 192
TURN_FRAMES = 48
STAGES = 5
FRAMED = 0.99
"""Share of the cloud that fits into a picture of it whole: strays would make all else tiny."""
REACH = 0.6
"""Close pictures leave out points farther from the scene's centre than this share of the cameras'
distance: they would hide the object.
"""


def draw_growth(scene_map: GlobalMap, cloud: PointCloud, path: Path) -> None:
    """A strip of the cloud after the inputs and after more and more views, from both sides: close,
    and from where the whole cloud at the end fits into the picture.
    """
    given = len(scene_map.given)
    stages = sorted({round(n) for n in np.linspace(given, len(scene_map), STAGES)})
    close = _turn(scene_map, 2)
    far = framed(close, cloud)
    columns = {}
    for count in stages:
        title = f"{given} inputs" if count == given else f"+ {count - given} views"
        then = cloud[cloud.view < count]
        columns[title] = torch.cat(
            [_draw_cloud(_select_near(then, close), close), _draw_cloud(then, far)]
        )
    draw_contact_sheet(columns, path)


def draw_turntable(scene_map: GlobalMap, cloud: PointCloud, path: Path) -> None:
    """A film around the whole cloud."""
    cameras = _turn(scene_map, TURN_FRAMES)
    write_film(_draw_cloud(_select_near(cloud, cameras), cameras), path)


def framed(cameras: Camera, cloud: PointCloud) -> Camera:
    """The cameras, all at one distance from what they look at, which the cloud fits into.

    A point at (x, y, z) from the scene's centre, in a camera's axes, is in its picture from the
    distance max(|x| fx / cx, |y| fy / cy) - z on; the middle of the picture must be its centre.
    """
    if not len(cloud):
        return cameras
    center = torch.from_numpy(scene_center(cameras)).to(cloud.points)
    needed = []
    for camera in (cameras[i] for i in range(len(cameras.world_to_cam))):
        x, y, z = ((cloud.points - center) @ camera.world_to_cam[:3, :3].mT).unbind(-1)
        k = camera.intrinsics
        aside = torch.maximum(x.abs() * k[0, 0] / k[0, 2], y.abs() * k[1, 1] / k[1, 2])
        needed.append((aside - z).quantile(FRAMED))
    moved = cameras.world_to_cam.clone()
    moved[:, :3, 3] = -(moved[:, :3, :3] @ center)
    moved[:, 2, 3] += torch.stack(needed).max()
    return replace(cameras, world_to_cam=moved)


def draw_plan(scene_map: GlobalMap, queries: Sequence[Query], path: Path) -> None:
    """Inputs and queries seen from above, numbered in the order in which they are planned."""
    orbit = fit_orbit_of_few(scene_map.cameras)
    plane = np.stack([orbit.east, np.cross(orbit.axis, orbit.east)], 1)
    figure, axes = plt.subplots(figsize=(5, 5), layout="constrained")
    planned = stack_cameras([query.camera for query in queries]) if queries else None
    for cameras, colour, label in ((scene_map.cameras, "C0", "given"), (planned, "C1", "planned")):
        if cameras is None:
            continue
        offsets, forward = camera_centers(cameras) - orbit.center, cameras.forward.double().numpy()
        plot_cameras(axes, offsets, forward, plane, colour, label)
    axes.legend()
    save_figure(figure, path)


def _turn(scene_map: GlobalMap, count: int) -> Camera:
    """Cameras around the scene at the inputs' mean height, the first where the inputs are."""
    given = stack_cameras([view.camera for view in scene_map.given])
    middle = camera_centers(given).mean(0)
    return circle_cameras(given, middle, count).resized(PICTURE_SIZE, PICTURE_SIZE)


def _select_near(cloud: PointCloud, cameras: Camera) -> PointCloud:
    center = torch.from_numpy(scene_center(cameras)).to(cloud.points)
    distance = (cameras.center - center).norm(dim=-1).mean()
    return cloud[(cloud.points - center).norm(dim=-1) < REACH * distance]


def _draw_cloud(cloud: PointCloud, cameras: Camera) -> Float[Tensor, "n 3 h w"]:
    """The cloud as each camera sees it, on white."""
    pictures = []
    for index in range(len(cameras.world_to_cam)):
        drawn = splat_points(cloud.points, cloud.colors, cameras[index])
        pictures.append(torch.where(drawn[-1] > 0, drawn[:-1], 1.0))
    return torch.stack(pictures)
