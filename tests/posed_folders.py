"""Folders of photographs with a `transforms.json`, as nerfstudio writes them."""

import json

import numpy as np
from PIL import Image

from extrap_train.geometry.foreign_cameras import opengl_from_world_to_cam


def write_transforms(folder, views, **common):
    """A nerfstudio folder; depth files in millimetres."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for index, view in enumerate(views):
        stem = f"{index:03d}"
        Image.fromarray(to_bytes(view.image.permute(1, 2, 0))).save(folder / f"images/{stem}.png")
        Image.fromarray(to_bytes(view.mask)).save(folder / f"mask_{stem}.png")
        depth = (view.depth.numpy() * 1000).round().astype(np.uint16)
        Image.fromarray(depth).save(folder / f"depth_{stem}.png")
        k = view.camera.intrinsics
        frames.append(
            {
                "file_path": f"./images/{stem}.png",
                "transform_matrix": opengl_from_world_to_cam(view.camera.world_to_cam).tolist(),
                "fl_x": k[0, 0].item(),
                "fl_y": k[1, 1].item(),
                "cx": k[0, 2].item(),
                "cy": k[1, 2].item(),
                "depth_file_path": f"depth_{stem}.png",
                "mask_path": f"mask_{stem}.png",
            }
        )
    height, width = views[0].camera.height, views[0].camera.width
    write_json(folder, {"camera_model": "OPENCV", "h": height, "w": width, "frames": frames})
    if common:
        write_json(folder, read_json(folder) | common)


def to_bytes(values):
    return (values.numpy() * 255).round().astype(np.uint8)


def read_json(folder):
    return json.loads((folder / "transforms.json").read_text())


def write_json(folder, content):
    (folder / "transforms.json").write_text(json.dumps(content))
