"""OpenGL's camera axes (+X right, +Y up, −Z forward; nerfstudio, Blender) to ours and back."""

import roma
from jaxtyping import Float
from torch import Tensor


def world_to_cam_from_opengl(cam_to_world: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Our `world_to_cam` from an OpenGL camera's `cam_to_world`, which must be rigid."""
    return rigid_inverse(flip_up_and_forward(cam_to_world))


def opengl_from_world_to_cam(world_to_cam: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """An OpenGL camera's `cam_to_world` from our `world_to_cam`."""
    return flip_up_and_forward(rigid_inverse(world_to_cam))


def flip_up_and_forward(cam_to_world: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Swap between the two conventions; the world stays as it is."""
    return cam_to_world * cam_to_world.new_tensor([1.0, -1.0, -1.0, 1.0])


def rigid_inverse(rigid: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """The inverse of a rotation and a translation."""
    return roma.Rigid.from_homogeneous(rigid).inverse().to_homogeneous()
