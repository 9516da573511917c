"""Alignment of a new view by gradient descent over the graph, as pairwise 3-D models are usually
aligned: poses and known depths frozen, Adam over the edges' similarities and the new depth.
"""

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.alignment import Edges
from extrap_train.geometry.cameras import pixel_grid, transform
from extrap_train.views import Camera

STEPS = 300
LEARNING_RATE = 0.01


def align_by_descent(camera: Camera, edges: Edges, steps: int = STEPS) -> Float[Tensor, "h w"]:
    """Minimise the confidence-weighted distances of both views' points to where they belong.

    Starts from each edge's plain weighted Procrustes and the first edge's depth; cosine schedule.
    """
    rays = _rays(camera, edges.new_points)
    known_weight = edges.known_confidence.log1p() * edges.world_known
    new_weight = edges.new_confidence.log1p()
    rotation, shift, scale = roma.rigid_points_registration(
        edges.known_points, edges.world_points, weights=known_weight, compute_scaling=True
    )
    first = transform(camera.world_to_cam, _moved(rotation, shift, scale, edges.new_points[:1])[0])
    log_depth = first[..., 2].clamp(min=1e-3).log().requires_grad_()
    quaternion = roma.rotmat_to_unitquat(rotation).requires_grad_()
    shift, log_scale = shift.requires_grad_(), scale.log().requires_grad_()
    parameters = [log_depth, quaternion, shift, log_scale]
    optimizer = torch.optim.Adam(parameters, lr=LEARNING_RATE, betas=(0.9, 0.9))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        unit = quaternion / quaternion.norm(dim=-1, keepdim=True)
        pose = (roma.unitquat_to_rotmat(unit), shift, log_scale.exp())
        new_world = transform(camera.cam_to_world, rays * log_depth.exp()[..., None])
        new_error = (_moved(*pose, edges.new_points) - new_world).norm(dim=-1)
        known_error = (_moved(*pose, edges.known_points) - edges.world_points).norm(dim=-1)
        loss = (new_error * new_weight).mean() + (known_error * known_weight).mean()
        loss.backward()
        optimizer.step()
        schedule.step()
    return log_depth.detach().exp()


def _rays(camera: Camera, like: Tensor) -> Float[Tensor, "h w 3"]:
    grid = pixel_grid(camera.height, camera.width).to(like)
    k = camera.intrinsics
    x, y = (grid[..., 0] - k[0, 2]) / k[0, 0], (grid[..., 1] - k[1, 2]) / k[1, 1]
    return torch.stack([x, y, torch.ones_like(x)], -1)


def _moved(rotation: Tensor, shift: Tensor, scale: Tensor, points: Tensor) -> Tensor:
    """The first of the points' edges, or all of them, in the world."""
    flat = points.flatten(1, -2)
    count = len(flat)
    turned = flat @ rotation[:count].mT
    return (scale[:count, None, None] * turned + shift[:count, None]).view_as(points)
