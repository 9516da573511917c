"""Depth of a folder of photographs by Depth Anything 3, which is given their cameras if they have
any, and finds and writes them otherwise.

python workers/run_depth_anything_3.py PHOTOGRAPHS DEPTH [WEIGHTS]

Runs in an environment with `depth-anything-3` and a GPU. WEIGHTS is a folder or a name on the hub.
"""

import sys

import numpy as np
import torch
from depth_anything_3.api import DepthAnything3
from scene_folder import Photograph, read_photographs, write_cameras, write_depth


def estimate_depth(photographs: str, depth: str, weights: str = "depth-anything/DA3-BASE") -> None:
    """Write a file of depth for every photograph.

    `forward` is called, because `inference` fits poses, which fails for two views.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = DepthAnything3.from_pretrained(weights).to(device).eval()
    found = read_photographs(photographs, longest=504)
    is_posed = found[0].world_to_cam is not None
    cameras = _normalised_cameras(found) if is_posed else (None, None)
    inputs = model.input_processor(
        [each.image for each in found], *cameras, 504, "upper_bound_resize"
    )
    given = (part if part is None else part[None].float().to(device) for part in inputs)
    output = model.forward(*given, export_feat_layers=[])
    names = ("depth", "depth_conf") + (() if is_posed else ("intrinsics", "extrinsics"))
    depths, confidences, *own = (output[name].float().cpu().numpy() for name in names)
    if not is_posed:
        depth = write_cameras(depth, found, *own, weights)
    shape = (len(found), *found[0].image.shape[:2])
    maps = (depths.reshape(shape), confidences.reshape(shape))
    for each, its_depth, confidence in zip(found, *maps, strict=True):
        write_depth(depth, each, its_depth, confidence)


def _normalised_cameras(photographs: list[Photograph]) -> tuple[np.ndarray, np.ndarray]:
    """Poses of which the first is the world, at a median distance of 1; and intrinsics."""
    poses = np.stack([each.world_to_cam for each in photographs])
    poses = poses @ np.linalg.inv(poses[0])
    distances = np.linalg.norm(np.linalg.inv(poses)[:, :3, 3], axis=-1)
    poses[:, :3, 3] /= max(np.median(distances), 0.1)
    return poses, np.stack([each.intrinsics for each in photographs])


if __name__ == "__main__":
    estimate_depth(*sys.argv[1:])
