"""A batch that looks like a real one, and a model that is not trained."""

import math

import torch
from torch import nn

from extrap_train.config import ModelConfig
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.geometry.warp import compute_warp
from extrap_train.views import Camera, PairBatch, stack_cameras


def camera_at(azimuth_rad: float, size: int) -> Camera:
    """A camera 4 units from the origin, looking at it from `azimuth_rad`."""
    cosine, sine = math.cos(azimuth_rad), math.sin(azimuth_rad)
    world_to_cam = torch.tensor(
        [[cosine, 0, -sine, 0], [0, 1, 0, 0], [sine, 0, cosine, 4], [0, 0, 0, 1]]
    )
    half = size / 2
    intrinsics = torch.tensor([[1.2 * size, 0, half], [0, 1.2 * size, half], [0, 0, 1.0]])
    return Camera(world_to_cam, intrinsics, size, size)


def batch_of(count: int, size: int = 32, references: int = 3, seed: int = 0) -> PairBatch:
    """Smooth random photographs of bumpy walls, on an arc."""
    generator = torch.Generator().manual_seed(seed)

    def smooth(*shape: int) -> torch.Tensor:
        coarse = torch.rand(*shape, 4, 4, generator=generator).flatten(0, -4)
        fine = torch.nn.functional.interpolate(coarse, size=(size, size), mode="bilinear")
        return fine.view(*shape, size, size)

    cameras = [
        stack_cameras([camera_at(0.3 * (k + 1), size) for k in range(references)])
        for _ in range(count)
    ]
    return compute_warp(
        PairBatch(
            image=smooth(count, 3),
            camera=stack_cameras([camera_at(0.0, size)] * count),
            reference_images=smooth(count, references, 3),
            reference_cameras=stack_cameras(cameras),
            reference_depths=4 + 0.2 * smooth(count, references, 1)[:, :, 0],
            reference_valid=torch.ones(count, references, dtype=torch.bool),
        )
    )


def random_model(config: ModelConfig) -> ExtrapolationModel:
    """The same for every call, with an output of its own beside the warp."""
    torch.manual_seed(0)
    model = ExtrapolationModel(config).eval()
    nn.init.normal_(model.unet.conv_out.weight, std=0.05)
    return model
