"""Depth of a folder of photographs by MapAnything, which is given their cameras.

python workers/run_map_anything.py PHOTOGRAPHS DEPTH [WEIGHTS]

Runs in an environment with `mapanything`. WEIGHTS is a folder or a name on the hub.
"""

import sys

import numpy as np
import torch
from mapanything.models import MapAnything
from mapanything.utils.image import preprocess_inputs
from scene_folder import read_photographs, write_depth


def estimate_depth(
    photographs: str, depth: str, weights: str = "facebook/map-anything-apache"
) -> None:
    """Write a file of depth for every photograph; what the network masks out has confidence 0."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = MapAnything.from_pretrained(weights).to(device).eval()
    found = read_photographs(photographs, longest=518)
    views = [
        {
            "img": torch.from_numpy(each.image.copy()),
            "intrinsics": torch.from_numpy(each.intrinsics).float(),
            "camera_poses": torch.from_numpy(np.linalg.inv(each.world_to_cam)).float(),
            "is_metric_scale": torch.tensor([False]),
        }
        for each in found
    ]
    height, width = found[0].image.shape[:2]
    views = preprocess_inputs(views, resize_mode="fixed_size", size=(width, height))
    predictions = model.infer(views, apply_mask=False)
    for each, prediction in zip(found, predictions, strict=True):
        depth_z, confidence, mask = (
            prediction[name].float().cpu().numpy().reshape(height, width)
            for name in ("depth_z", "conf", "mask")
        )
        write_depth(depth, each, depth_z, confidence * mask)


if __name__ == "__main__":
    estimate_depth(*sys.argv[1:])
