"""COLMAP's sparse models, text and binary: cameras and images; points in space are not needed."""

from pathlib import Path

import torch

from extrap_train.data.colmap_binary import read_binary_cameras, read_binary_images
from extrap_train.data.colmap_records import ModelCamera, ModelImage
from extrap_train.data.colmap_text import read_text_cameras, read_text_images
from extrap_train.data.paths import check_relative
from extrap_train.data.photographs import Photograph, present_pictures, sequence_of_photographs
from extrap_train.data.sequences import PointCloud, Sequence
from extrap_train.errors import InputError
from extrap_train.geometry.colmap import world_to_cam_from_colmap

POINT_CLOUD = "points3D.ply"
"""Some tools leave one beside the model."""


def find_model(folder: Path) -> Path | None:
    """The folder with the model files: `folder` itself, its `sparse/0` or its `sparse`."""
    for candidate in (folder, folder / "sparse" / "0", folder / "sparse"):
        if any((candidate / f"images.{kind}").is_file() for kind in ("bin", "txt")):
            return candidate
    return None


def read_model(model: Path, images: Path, name: str) -> Sequence:
    """The capture of a COLMAP model; `images` is the folder that its picture names start from.

    Distortion is undone when a frame is read. Entries without a picture are left out with one
    warning.
    """
    kind = "bin" if (model / "images.bin").is_file() else "txt"
    cameras_file, images_file = model / f"cameras.{kind}", model / f"images.{kind}"
    for file in (cameras_file, images_file):
        if not file.is_file():
            raise InputError(f"{file}: no such file; export the whole COLMAP model")
    if kind == "bin":
        cameras, entries = read_binary_cameras(cameras_file), read_binary_images(images_file)
    else:
        cameras, entries = read_text_cameras(cameras_file), read_text_images(images_file)
    if not entries:
        raise InputError(f"{images_file}: lists no picture; run COLMAP again")
    paths = [check_relative(entry.name, images_file) for entry in entries]
    present = present_pictures(images, paths, images_file)
    by_number = _by_number(cameras, cameras_file)
    return sequence_of_photographs(
        images,
        name,
        [_photograph(entry, by_number, images_file) for entry in entries if entry.name in present],
        images_file,
        point_cloud=PointCloud(model, POINT_CLOUD),
    )


def _by_number(cameras: list[ModelCamera], file: Path) -> dict[int, ModelCamera]:
    found: dict[int, ModelCamera] = {}
    for camera in cameras:
        if camera.number in found:
            raise InputError(f"{file}: lists camera {camera.number} twice; export the model again")
        found[camera.number] = camera
    return found


def _photograph(entry: ModelImage, cameras: dict[int, ModelCamera], file: Path) -> Photograph:
    if entry.camera not in cameras:
        raise InputError(
            f"{file}: {entry.name} names camera {entry.camera}, which the model does not have; "
            "export the model again"
        )
    camera = cameras[entry.camera]
    quaternion = torch.tensor(entry.quaternion_wxyz, dtype=torch.float64)
    translation = torch.tensor(entry.translation, dtype=torch.float64)
    return Photograph(
        image_path=entry.name,
        height=camera.height,
        width=camera.width,
        lens=camera.lens,
        world_to_cam=world_to_cam_from_colmap(quaternion, translation),
    )
