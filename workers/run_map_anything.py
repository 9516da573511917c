"""Depth of a folder of photographs by MapAnything, which is given their cameras if they have any,
and finds and writes them otherwise.

python workers/run_map_anything.py PHOTOGRAPHS DEPTH [WEIGHTS]

Runs in an environment with `mapanything`. WEIGHTS is a folder or a name on the hub.
"""

import sys

import numpy as np
import torch
from mapanything.models import MapAnything
from mapanything.utils.image import preprocess_inputs
from scene_folder import Photograph, read_photographs, write_cameras, write_depth


def estimate_depth(
    photographs: str, depth: str, weights: str = "facebook/map-anything-apache"
) -> None:
    """Write a file of depth for every photograph; what the network masks out has confidence 0."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = MapAnything.from_pretrained(weights).to(device).eval()
    found = read_photographs(photographs, longest=518)
    height, width = found[0].image.shape[:2]
    views = preprocess_inputs(
        [_view(each) for each in found], resize_mode="fixed_size", size=(width, height)
    )
    predictions = model.infer(views, apply_mask=False)
    if found[0].world_to_cam is None:
        intrinsics, poses = (
            np.concatenate([prediction[name].float().cpu().numpy() for prediction in predictions])
            for name in ("intrinsics", "camera_poses")
        )
        depth = write_cameras(depth, found, intrinsics, np.linalg.inv(poses), weights)
    for each, prediction in zip(found, predictions, strict=True):
        depth_z, confidence, mask = (
            prediction[name].float().cpu().numpy().reshape(height, width)
            for name in ("depth_z", "conf", "mask")
        )
        write_depth(depth, each, depth_z, confidence * mask)


def _view(photograph: Photograph) -> dict[str, torch.Tensor]:
    view = {"img": torch.from_numpy(photograph.image.copy())}
    if photograph.world_to_cam is None:
        return view
    return view | {
        "intrinsics": torch.from_numpy(photograph.intrinsics).float(),
        "camera_poses": torch.from_numpy(np.linalg.inv(photograph.world_to_cam)).float(),
        "is_metric_scale": torch.tensor([False]),
    }


if __name__ == "__main__":
    estimate_depth(*sys.argv[1:])
