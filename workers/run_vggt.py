"""Depth of a folder of photographs by VGGT, which finds cameras of its own.

They are written, too, if the photographs come without.

python workers/run_vggt.py PHOTOGRAPHS DEPTH [WEIGHTS]

Runs in an environment with `vggt`. WEIGHTS is a folder or a name on the hub.
"""

import sys

import numpy as np
import torch
from scene_folder import read_photographs, write_cameras, write_depth
from vggt.models.vggt import VGGT
from vggt.utils.pose_enc import pose_encoding_to_extri_intri


def estimate_depth(photographs: str, depth: str, weights: str = "facebook/VGGT-1B") -> None:
    """Write a file of depth for every photograph."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = VGGT.from_pretrained(weights).to(device).eval()
    found = read_photographs(photographs, longest=518)
    images = torch.from_numpy(np.stack([each.image for each in found])).to(device)
    with torch.no_grad(), torch.autocast(device, dtype=torch.bfloat16):
        predictions = model(images.permute(0, 3, 1, 2).float() / 255)
    if found[0].world_to_cam is None:
        cameras = pose_encoding_to_extri_intri(predictions["pose_enc"].float(), images.shape[1:3])
        poses, intrinsics = (part.cpu().numpy() for part in cameras)
        depth = write_cameras(depth, found, intrinsics, poses, weights)
    shape = (len(found), *found[0].image.shape[:2])
    maps = (
        predictions[name].float().cpu().numpy().reshape(shape) for name in ("depth", "depth_conf")
    )
    for each, its_depth, confidence in zip(found, *maps, strict=True):
        write_depth(depth, each, its_depth, confidence)


if __name__ == "__main__":
    estimate_depth(*sys.argv[1:])
