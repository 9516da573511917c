"""Pictures of the cloud: how it grows view by view, and a turn around it (the paper's Fig. 3)."""

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.data.files import write_whole
from extrap_train.geometry.splat import splat
from extrap_train.geometry.viewpoints import camera_centers, scene_center
from extrap_train.pictures import contact_sheet, film
from extrap_train.reconstruction.cloud import PointCloud
from extrap_train.reconstruction.global_map import GIVEN, GlobalMap
from extrap_train.reconstruction.planner import Query, circle_cameras, fit_circle
from extrap_train.views import Camera, stack_cameras

PICTURE_SIZE = 192
TURN_FRAMES = 48
STAGES = 5
REACH = 0.6
"""Points farther from the scene's centre than this share of the cameras' distance are not drawn:
they would hide the object.
"""


def draw_growth(known: GlobalMap, cloud: PointCloud, path: Path) -> None:
    """A strip of the cloud after the inputs and after more and more views, from both sides."""
    given = sum(view.origin.kind == GIVEN for view in known.views)
    stages = sorted({round(n) for n in np.linspace(given, len(known), STAGES)})
    cameras = _turn(known, 2)
    columns = {}
    for count in stages:
        title = f"{given} inputs" if count == given else f"+ {count - given} views"
        columns[title] = _drawn(cloud[cloud.view < count], cameras)
    contact_sheet(columns, path)


def draw_turntable(known: GlobalMap, cloud: PointCloud, path: Path) -> None:
    """A film around the whole cloud."""
    film(_drawn(cloud, _turn(known, TURN_FRAMES)), path)


def draw_plan(known: GlobalMap, queries: Sequence[Query], path: Path) -> None:
    """Inputs and queries seen from above, numbered in the order in which they are planned."""
    circle = fit_circle(known.cameras)
    north = np.cross(circle.axis, circle.east)
    figure, axes = plt.subplots(figsize=(5, 5), layout="constrained")
    planned = stack_cameras([query.camera for query in queries]) if queries else None
    for cameras, colour, label in ((known.cameras, "C0", "given"), (planned, "C1", "planned")):
        if cameras is None:
            continue
        offsets = camera_centers(cameras) - circle.center
        x, y = offsets @ circle.east, offsets @ north
        forward = cameras.forward.double().numpy()
        length = 0.2 * np.linalg.norm(offsets, axis=1).mean()
        axes.quiver(
            x, y, length * (forward @ circle.east), length * (forward @ north),
            color=colour, angles="xy", scale_units="xy", scale=1, width=0.006, label=label,
        )  # fmt: skip
        for number, (u, v) in enumerate(zip(x, y, strict=True)):
            axes.annotate(str(number + 1), (u, v), color=colour)
    axes.plot(0, 0, "k+")
    axes.set_aspect("equal")
    axes.legend()
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=100)
    plt.close(figure)
    write_whole(path, content.getvalue())


def _turn(known: GlobalMap, count: int) -> Camera:
    """Cameras around the scene at the inputs' mean height, the first where the inputs are."""
    given = stack_cameras([v.camera for v in known.views if v.origin.kind == GIVEN])
    middle = camera_centers(given).mean(0)
    return circle_cameras(given, middle, count).resized(PICTURE_SIZE, PICTURE_SIZE)


def _drawn(cloud: PointCloud, cameras: Camera) -> Float[Tensor, "n 3 h w"]:
    """The cloud as each camera sees it, on white."""
    center = torch.from_numpy(scene_center(cameras)).to(cloud.points)
    distance = (cameras.center - center).norm(dim=-1).mean()
    near = cloud[(cloud.points - center).norm(dim=-1) < REACH * distance]
    pictures = []
    for index in range(len(cameras.world_to_cam)):
        drawn = splat(near.points, near.colors, cameras[index])
        pictures.append(torch.where(drawn.weight > 0, drawn.values, 1.0))
    return torch.stack(pictures)
