"""Depth of a folder of photographs by Depth Anything 3, which is given their cameras.

python workers/run_depth_anything_3.py PHOTOGRAPHS DEPTH [WEIGHTS]

Runs in an environment with `depth-anything-3` and a GPU. WEIGHTS is a folder or a name on the hub.
"""

import sys

import numpy as np
import torch
from depth_anything_3.api import DepthAnything3
from scene_folder import read_photographs, write_depth


def estimate_depth(photographs: str, depth: str, weights: str = "depth-anything/DA3-BASE") -> None:
    """Write a file of depth for every photograph.

    `forward` is called, because `inference` fits poses, which fails for two views.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = DepthAnything3.from_pretrained(weights).to(device).eval()
    found = read_photographs(photographs, longest=504)
    poses = np.stack([each.world_to_cam for each in found])
    poses = poses @ np.linalg.inv(poses[0])  # the first camera is the world
    distances = np.linalg.norm(np.linalg.inv(poses)[:, :3, 3], axis=-1)
    poses[:, :3, 3] /= max(np.median(distances), 0.1)
    intrinsics = np.stack([each.intrinsics for each in found])
    images, poses, intrinsics = model.input_processor(
        [each.image for each in found], poses, intrinsics, 504, "upper_bound_resize"
    )
    given = (part[None].float().to(device) for part in (images, poses, intrinsics))
    output = model.forward(*given, export_feat_layers=[])
    shape = (len(found), *found[0].image.shape[:2])
    maps = (output[name].float().cpu().numpy().reshape(shape) for name in ("depth", "depth_conf"))
    for each, its_depth, confidence in zip(found, *maps, strict=True):
        write_depth(depth, each, its_depth, confidence)


if __name__ == "__main__":
    estimate_depth(*sys.argv[1:])
