"""Posed photographs in a folder, whatever lists them: paths, lenses and poses to a sequence."""

import logging
from collections.abc import Sequence as List
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.data.images import read_depth, read_photograph
from extrap_train.data.paths import resolve_inside
from extrap_train.data.sequences import Frame, PointCloud, Sequence
from extrap_train.data.validation import degenerate_camera, require_sound
from extrap_train.errors import InputError
from extrap_train.geometry.lens import Lens, undistort
from extrap_train.views import Camera, View, stack_cameras

CATEGORY = "scene"
"""What stands for a category where a capture has none."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Photograph:
    """What a description says of one picture; paths are relative to the capture's folder."""

    image_path: str
    height: int
    width: int
    lens: Lens
    world_to_cam: Float[Tensor, "4 4"]
    depth_path: str | None = None
    depth_scale: float = 1.0
    """Scene units per unit of the depth file."""
    mask_path: str | None = None


@dataclass(frozen=True)
class _Loader:
    """Reads one photograph and undoes its lens; a dataclass, so that workers can be sent it."""

    root: Path
    photograph: Photograph
    pinhole: Lens
    camera: Camera
    name: str

    @property
    def files(self) -> tuple[Path, ...]:
        photo = self.photograph
        paths = (photo.image_path, photo.mask_path, photo.depth_path)
        return tuple(self.root / path for path in paths if path)

    def load(self, *, depth: bool = True) -> View:
        photo, size = self.photograph, (self.camera.height, self.camera.width)
        image_path = resolve_inside(self.root, photo.image_path)
        mask_path = resolve_inside(self.root, photo.mask_path) if photo.mask_path else None
        image, mask = read_photograph(image_path, size, mask_path)
        far = _read_depth(self.root, photo) if depth and photo.depth_path else None
        return View(
            image=self._straight(image.permute(1, 2, 0)).permute(2, 0, 1).contiguous(),
            camera=self.camera,
            depth=None if far is None else self._straight(far, nearest=True),
            mask=None if mask is None else self._straight(mask),
            name=self.name,
        )

    def _straight(self, picture: Tensor, nearest: bool = False) -> Tensor:
        lens = self.photograph.lens
        if lens.is_pinhole:
            return picture
        return torch.from_numpy(undistort(picture.numpy(), lens, self.pinhole, nearest))


def present_pictures(root: Path, paths: List[str], description: Path) -> set[str]:
    """Those of `paths` that exist below `root`; the missing are named in one warning.

    `description` is the file that lists them. Raises InputError where none exists.
    """
    present = {path for path in paths if (root / path).is_file()}
    missing = sorted(set(paths) - present)
    if not present:
        raise InputError(
            f"{description}: none of the {len(paths)} pictures it lists is in {root}; "
            "put the pictures there"
        )
    if missing:
        log.warning(
            "%s: %d of %d entries have no picture and are left out: %s",
            description,
            len(missing),
            len(paths),
            ", ".join(missing[:3]) + (", …" if len(missing) > 3 else ""),
        )
    return present


def sequence_of_photographs(
    root: Path,
    name: str,
    photographs: List[Photograph],
    description: Path,
    point_cloud: PointCloud | None = None,
) -> Sequence:
    """A sequence of photographs in the order of their paths.

    `description` is the file that lists them. Raises InputError where a picture is listed
    twice, a camera is degenerate or a lens cannot be undone.
    """
    ordered = sorted(photographs, key=lambda photo: photo.image_path)
    paths = [photo.image_path for photo in ordered]
    if len(set(paths)) != len(paths):
        raise InputError(f"{description}: lists a picture twice; remove the second entry")
    frames = []
    for photo, frame_name in zip(ordered, _frame_names(paths), strict=True):
        pinhole, camera = pinhole_camera(photo, description)
        loader = _Loader(root, photo, pinhole, camera, frame_name)
        frames.append(
            Frame(
                name=frame_name,
                camera=camera,
                has_depth=photo.depth_path is not None,
                has_mask=photo.mask_path is not None,
                load=loader.load,
                files=loader.files,
            )
        )
    return Sequence(CATEGORY, name, tuple(frames), point_cloud=point_cloud)


def _frame_names(paths: list[str]) -> list[str]:
    """File names where these are unique, else whole paths with the folders joined by `_`."""
    names = [Path(path).name for path in paths]
    if len(set(names)) == len(names):
        return names
    return ["_".join(Path(path).parts) for path in paths]


def pinhole_camera(photo: Photograph, description: Path) -> tuple[Lens, Camera]:
    """The camera of a photograph once its lens is undone; InputError where it is degenerate."""
    if not all(np.isfinite([*photo.lens.matrix.flat, *photo.lens.distortion])):
        raise InputError(f"{description}: the lens of {photo.image_path} is not finite; correct it")
    if not (photo.lens.fx > 0 and photo.lens.fy > 0):  # or its distortion would be blamed
        raise InputError(degenerate_camera(photo.image_path, description))
    try:
        pinhole = photo.lens.pinhole(photo.height, photo.width)
    except ValueError as error:
        raise InputError(
            f"{description}: {photo.image_path}: {error}; correct the lens or undistort beforehand"
        ) from None
    camera = Camera(
        photo.world_to_cam.float(),
        torch.from_numpy(pinhole.matrix).float(),
        photo.height,
        photo.width,
    )
    require_sound(stack_cameras([camera]), [photo.image_path], description)
    return pinhole, camera


def _read_depth(root: Path, photo: Photograph) -> Float[Tensor, "h w"]:
    path = resolve_inside(root, photo.depth_path or "")
    return read_depth(path, (photo.height, photo.width), photo.depth_scale)
