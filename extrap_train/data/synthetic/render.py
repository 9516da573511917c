"""A photograph of a synthetic scene: antialiased colour, exact depth, object mask."""

import numpy as np
import torch
from jaxtyping import Float

from extrap_train.data.synthetic.material import linear_to_srgb
from extrap_train.data.synthetic.scene import SyntheticScene
from extrap_train.data.synthetic.shading import radiance
from extrap_train.data.synthetic.vectors import rotated
from extrap_train.views import Camera, View


def render(scene: SyntheticScene, camera: Camera, supersample: int = 2) -> View:
    """A photograph of the scene; depth and mask are those of the ray through each pixel's centre.

    Colours are the mean linear light of `supersample`² rays a pixel, then encoded as sRGB.
    """
    height, width = camera.height, camera.width
    depth, mask = trace(scene, camera)
    light = radiance(scene, *_rays(camera, supersample), float(1 / camera.intrinsics[0, 0]))
    light = light.reshape(height, supersample, width, supersample, 3).clip(0, 1).mean((1, 3))
    image = linear_to_srgb(light).transpose(2, 0, 1).astype(np.float32)
    return View(
        torch.from_numpy(np.ascontiguousarray(image)),
        camera,
        depth,
        mask,
    )


def trace(
    scene: SyntheticScene, camera: Camera
) -> tuple[Float[torch.Tensor, "h w"], Float[torch.Tensor, "h w"]]:
    """Depth and object mask of the rays through the pixels' centres, without any colour."""
    centre = scene.cast(*_rays(camera, 1))
    found = centre.face >= 0
    is_object = np.array([part.is_object for part in scene.parts])[scene.part_of_face]
    maps = np.where(found, centre.distance, 0), is_object[centre.face] & found
    size = (camera.height, camera.width)
    depth, mask = (torch.from_numpy(m.reshape(size).astype(np.float32)) for m in maps)
    return depth, mask


def _rays(
    camera: Camera, supersample: int
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Origins and directions, row by row; with z = 1 in the camera, distance is depth."""
    k = camera.intrinsics.double().numpy()
    cam_to_world = camera.cam_to_world.double().numpy()
    columns = (np.arange(camera.width * supersample) + 0.5) / supersample
    rows = (np.arange(camera.height * supersample) + 0.5) / supersample
    x, y = np.meshgrid((columns - k[0, 2]) / k[0, 0], (rows - k[1, 2]) / k[1, 1])
    directions = rotated(np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3), cam_to_world[:3, :3])
    origins = np.broadcast_to(cam_to_world[:3, 3], directions.shape)
    return np.ascontiguousarray(origins, np.float32), directions.astype(np.float32)
