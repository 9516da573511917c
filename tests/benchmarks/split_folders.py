"""The community's split as its authors hand it out: folders of a few made-up scenes."""

import json
from pathlib import Path

from PIL import Image

from extrap_train.data.image_files import to_eight_bits
from extrap_train.geometry.foreign_cameras import opengl_from_world_to_cam
from tests.benchmarks.analytic import view_at


def write_split(root: Path, size: int, count: int) -> None:
    """One scene around the ball; its transforms.json lists the frames backwards."""
    folder = root / "34_1479_4753"
    (folder / "images").mkdir(parents=True)
    frames = []
    for index in range(count):
        view = view_at(360 * index / count, size)
        image = Image.fromarray(to_eight_bits(view.image.permute(1, 2, 0)))
        image.save(folder / "images" / f"frame{index:06d}.png")
        frames.append(
            {
                "file_path": f"images/frame{index:06d}.png",
                "transform_matrix": opengl_from_world_to_cam(view.camera.world_to_cam).tolist(),
            }
        )
    k = view.camera.intrinsics
    lens = {"fl_x": k[0, 0].item(), "fl_y": k[1, 1].item(), "cx": size / 2, "cy": size / 2}
    content = {**lens, "w": size, "h": size, "frames": frames[::-1]}
    (folder / "transforms.json").write_text(json.dumps(content))
    split = {"train_ids": [0, 2, 5], "test_ids": [1, 7]}
    (folder / "train_test_split_3.json").write_text(json.dumps(split))
