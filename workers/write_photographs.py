"""Write a scene's photographs and cameras for the workers beside this file.

python workers/write_photographs.py SCENE FOLDER [FRAME ...]

Runs in this project's environment. SCENE is what `scene=` takes; without frames, all are written.
"""

import sys
from pathlib import Path

import numpy as np

from extrap_train.data.image_files import to_eight_bits
from extrap_train.data.scene_spec import open_scene
from extrap_train.errors import InputError, did_you_mean

LONGEST = 1024
"""Side in pixels; no worker's network sees more."""


def write_photographs(scene: str, folder: str, *names: str) -> None:
    """Write `FOLDER/PATH.npz` for every photograph, or for those of these names.

    InputError where the folder holds such files: a network would see those photographs, too.
    """
    if any(Path(folder).rglob("*.npz")):
        raise InputError(f"{folder}: holds photographs already; remove it or give another folder")
    frames = {frame.name: frame for frame in open_scene(scene).frames}
    if unknown := [name for name in names if name not in frames]:
        raise InputError(f"{scene}: has no frame {unknown[0]}; {did_you_mean(unknown[0], frames)}")
    for name in names or frames:
        view = frames[name].load(depth=False)
        assert view.photograph is not None
        scale = min(1, LONGEST / max(view.camera.height, view.camera.width))
        small = view.resized(*(round(scale * side) for side in view.image.shape[1:]))
        file = Path(folder, view.photograph.path).with_suffix(".npz")
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(
            file,
            image=to_eight_bits(small.image.permute(1, 2, 0)),
            intrinsics=small.camera.intrinsics,
            world_to_cam=small.camera.world_to_cam,
        )


if __name__ == "__main__":
    try:
        write_photographs(*sys.argv[1:])
    except InputError as error:
        sys.exit(f"error: {error}")
