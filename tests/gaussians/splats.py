"""Random Gaussians before a camera."""

import torch

from extrap_train.gaussians.gaussian_model import Gaussians


def random_gaussians(count, degree=0, seed=0):
    """In a cube of side 2 around the origin, of all sizes and opacities."""
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.rand(count, 3, generator=g) * 2 - 1,
        quats=torch.randn(count, 4, generator=g),
        scales=torch.rand(count, 3, generator=g) * 0.3 + 0.02,
        opacities=torch.rand(count, generator=g) * 0.98 + 0.01,
        sh=torch.randn(count, (degree + 1) ** 2, 3, generator=g) * 0.4,
    )


def camera_pose(distance=3.0, angle_rad=0.4):
    """`world_to_cam` that looks at the origin, turned and shifted a little."""
    c, s = torch.cos(torch.tensor(angle_rad)), torch.sin(torch.tensor(angle_rad))
    pose = torch.eye(4)
    pose[0, 0], pose[0, 2], pose[2, 0], pose[2, 2] = c, s, -s, c
    pose[:3, 3] = torch.tensor([0.1, -0.05, distance])
    return pose


def pinhole(width, height):
    """Intrinsics with unequal focal lengths and an off-centre principal point."""
    return torch.tensor(
        [[1.2 * width, 0, width / 2 + 1], [0, 1.1 * width, height / 2 - 0.7], [0, 0, 1.0]]
    )
