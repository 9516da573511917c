"""Cameras, warps and viewpoints. This page holds every convention of the project.

Axes
    OpenCV: camera +X right, +Y down, +Z forward. Worlds have no preferred axes.
Transforms
    4×4, applied to column vectors from the left: `x_cam = world_to_cam @ x_world`. A name always
    says its direction (`world_to_cam`, `cam_to_world`, `reference_to_query`).
Intrinsics
    3×3 in pixels. Pixel centres lie at +0.5: the top-left pixel covers [0, 1)² and its centre is
    (0.5, 0.5), so an image of width `w` with a centred principal point has `cx = w / 2`. No skew.
Depth
    z in the camera's frame (not the length of the ray), in scene units; 0 means unknown.
Images
    float in [0, 1], channels first (`3 h w`). Masks are float in [0, 1], `h w`; 1 is the object.
Pixel coordinates
    (u, v) = (column, row), in pixels as above; *normalised* coordinates are u/w·2 − 1 and v/h·2 − 1
    in [−1, 1].
Angles
    radians inside, and names end in `_rad`; degrees only where a person types or reads them
    (`_deg`).
Batches
    leading dimensions; tensors are `b c h w`, several references of one query `b k c h w`.

Foreign conventions are converted at the door, by `foreign_cameras.py` alone: PyTorch3D's (CO3D: row
vectors, +X left, +Y up, both NDC formats), OpenGL's (nerfstudio, ZeroNVS: +Y up, −Z forward) and
COLMAP's (quaternions, camera models).
"""
