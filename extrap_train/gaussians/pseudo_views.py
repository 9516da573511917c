"""Cameras between the input views, where no photograph was taken (FSGS, section 3.3)."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.views import Camera


def pseudo_camera(
    cameras: Sequence[Camera], generator: torch.Generator, jitter: float = 0.05
) -> Camera:
    """A camera on the way from one input to the input nearest to it, looking at the same place.

    The position moves on the arc around the origin (the frame's centre) and is shifted by `jitter`
    times its distance at random; the viewing directions are averaged in the same share.
    """
    first = int(torch.randint(len(cameras), (1,), generator=generator))
    centers = torch.stack([camera.center for camera in cameras])
    distance = (centers - centers[first]).norm(dim=-1)
    distance[first] = math.inf
    a, b = cameras[first], cameras[int(distance.argmin())]
    share = float(torch.rand((), generator=generator))
    center = _on_arc(a.center, b.center, share)
    noise = torch.randn(3, generator=generator).to(center)
    center = center + jitter * center.norm() * noise
    forward = (1 - share) * a.forward + share * b.forward
    down = (1 - share) * a.world_to_cam[1, :3] + share * b.world_to_cam[1, :3]
    return replace(a, world_to_cam=looking(center, forward, down))


def _on_arc(a: Float[Tensor, "3"], b: Float[Tensor, "3"], share: float) -> Float[Tensor, "3"]:
    straight = (1 - share) * a + share * b
    radius = (1 - share) * a.norm() + share * b.norm()
    return straight / straight.norm().clamp_min(1e-6) * radius


def looking(
    center: Float[Tensor, "3"], forward: Float[Tensor, "3"], down: Float[Tensor, "3"]
) -> Float[Tensor, "4 4"]:
    """world_to_cam of a camera at `center`; `down` need not be square to `forward`."""
    z = forward / forward.norm()
    x = torch.linalg.cross(down, z)
    x = x / x.norm()
    rotation = torch.stack([x, torch.linalg.cross(z, x), z])
    world_to_cam = torch.eye(4).to(center)
    world_to_cam[:3, :3], world_to_cam[:3, 3] = rotation, -rotation @ center
    return world_to_cam
