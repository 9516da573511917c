"""Posed photographs in a folder, whatever lists them: paths, lenses and poses to a sequence."""

import logging
import posixpath
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.data.camera_check import PoseConvention, find_pose_fault, require_sound
from extrap_train.data.depth_files import DepthFile
from extrap_train.data.image_files import image_size, read_photograph, same_view
from extrap_train.data.listed_files import PICTURE_SUFFIXES, ListedFiles
from extrap_train.data.paths import require_file
from extrap_train.data.sequences import Frame, FrameSequence, PointCloud
from extrap_train.errors import InputError
from extrap_train.geometry.lens import Lens, undistort
from extrap_train.views import Camera, View, stack_poses


@dataclass(frozen=True, slots=True)
class PhotographLoader:
    """One photograph's files; a dataclass and no closure, so that it can be sent to workers."""

    root: Path
    name: str
    camera: Camera
    """Of the undistorted photograph."""
    image_path: str
    mask_path: str | None = None
    depth: DepthFile | None = None
    lens: Lens | None = None
    """To be undone; None for a pinhole camera's photograph."""
    pinhole: Lens | None = None
    """That of `camera`, where there is a lens to undo."""
    upright: bool = False
    """Whether the camera holds the photograph as its EXIF orientation turns it."""

    def frame(self) -> Frame:
        """The photograph as a frame that has not been read yet."""
        parts = [str(self.lens)] if self.lens else []
        parts.append(f"depth in {self.depth.scale if self.depth else None}")
        parts += ["upright"] if self.upright else []
        return Frame(
            name=self.name,
            camera=self.camera,
            has_depth=self.depth is not None,
            has_mask=self.mask_path is not None,
            load=self.load,
            files=self._files(),
            reading=", ".join(parts),
        )

    def load(self, *, depth: bool = True) -> View:
        """See `sequences.Load`."""
        size = self.camera.height, self.camera.width
        image_path = require_file(self.root / self.image_path)
        mask_path = require_file(self.root / self.mask_path) if self.mask_path else None
        image, mask = read_photograph(image_path, size, mask_path, self.upright)
        found = self.depth.read(self.root, size) if depth and self.depth else None
        return View(
            image=self._straighten(image.permute(1, 2, 0)).permute(2, 0, 1).contiguous(),
            camera=self.camera,
            depth=None if found is None else self._straighten(found, nearest=True),
            mask=None if mask is None else self._straighten(mask),
            name=self.name,
        )

    def _files(self) -> tuple[Path, ...]:
        depth = (self.depth.path, self.depth.mask_path) if self.depth else ()
        return tuple(self.root / p for p in (self.image_path, self.mask_path, *depth) if p)

    def _straighten(self, picture: Tensor, nearest: bool = False) -> Tensor:
        if self.lens is None or self.pinhole is None:
            return picture
        return torch.from_numpy(undistort(picture.numpy(), self.lens, self.pinhole, nearest))


CATEGORY = "scene"
"""What stands for a category where a capture has none."""
MAX_FRAMES = 100_000
"""Of a capture; more are no capture of one scene."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Photograph:
    """What a description says of one picture; paths are relative to the capture's folder."""

    image_path: str
    height: int
    width: int
    lens: Lens
    world_to_cam: Float[Tensor, "4 4"]
    depth: DepthFile | None = None
    mask_path: str | None = None
    upright: bool = False


@dataclass(frozen=True)
class Listed:
    """An entry of a description."""

    path: str
    """Of its picture, as it stands there; it has passed `check_relative`."""
    describe: Callable[[str], Photograph]
    """The photograph, by the path at which the picture was found; InputError where the entry cannot
    be used."""


def sequence_of_photographs(
    files: ListedFiles,
    name: str,
    listed: Sequence[Listed],
    description: Path,
    convention: PoseConvention,
    unusable: Sequence[str] = (),
    point_cloud: PointCloud | None = None,
) -> FrameSequence:
    """A sequence of the photographs below `files.root`, in the order of their paths.

    `description` is the file that lists them; `unusable` says of more of its entries why they name
    no picture. Entries without a picture, and those that cannot be used or contradict each other,
    are left out with one warning each kind. Raises InputError where none is left, or the cameras
    can see nothing in common.
    """
    count = len(listed) + len(unusable)
    if count > MAX_FRAMES:
        raise InputError(f"{description}: lists more than {MAX_FRAMES:,} pictures; split it")
    pictures = _find_pictures(files, listed, description)
    names = _frame_names([_name_path(path, entries) for path, entries in pictures])
    frames, left_out, resized = [], [*unusable], []
    for (path, entries), frame_name in zip(pictures, names, strict=True):
        if not entries:
            continue
        try:
            annotated = _describe(path, entries, description)
            photo = _at_its_size(files.root, annotated)
            frames.append(_frame(files.root, photo, frame_name, description))
        except InputError as error:
            left_out.append(str(error))
            continue
        if photo is not annotated:
            resized.append(f"{path} has {photo.height} x {photo.width} pixels (height x width)")
    if not frames:
        raise InputError(left_out[0])
    if left_out:
        log.warning("%d of %d frames are left out: %s", len(left_out), count, left_out[0])
    if resized:
        say = "%s: %d pictures have another size than it says: their lenses are scaled (%s)"
        log.warning(say, description, len(resized), resized[0])
    if fault := find_pose_fault(stack_poses([frame.camera for frame in frames]), convention):
        raise InputError(f"{description}: {fault}")
    return FrameSequence(
        CATEGORY,
        name,
        tuple(frames),
        left_out=tuple(left_out),
        listed=tuple(names),
        point_cloud=point_cloud,
    )


def _find_pictures(
    files: ListedFiles, listed: Sequence[Listed], description: Path
) -> list[tuple[str, list[Listed]]]:
    """The pictures' paths in order, each with its entries: none where the picture is missing.

    Warns of these and of pictures listed twice; InputError where there is no picture at all.
    """
    entries: dict[str, list[Listed]] = {}
    missing = []
    for entry in listed:
        path = files.find(entry.path, PICTURE_SUFFIXES)
        if path is None:
            missing.append(entry.path)
            entries.setdefault(_normal(entry.path), [])
        else:
            entries.setdefault(path, []).append(entry)
    found = [path for path, same in entries.items() if same]
    if missing:
        count = f"only {len(found)}" if found else "none"
        fault = (
            f"{description}: {count} of the {len(entries)} pictures it lists is in {files.root} "
            f"({files.explain(missing[0])})"
        )
        if not found:
            raise InputError(f"{fault}; put the pictures there")
        log.warning("%s", fault)
    if twice := [path for path in found if len(entries[path]) > 1]:
        log.warning("%s: lists %d pictures twice (%s)", description, len(twice), twice[0])
    return sorted(entries.items())


def _describe(path: str, entries: Sequence[Listed], description: Path) -> Photograph:
    """The photograph that all entries of one picture describe; InputError where they disagree."""
    first, *others = [entry.describe(path) for entry in entries]
    for other in others:
        is_same_pose = torch.equal(first.world_to_cam, other.world_to_cam)
        if not is_same_pose or first != replace(other, world_to_cam=first.world_to_cam):
            raise InputError(
                f"{description}: lists {path} twice, with different cameras or files; remove the "
                "wrong entry"
            )
    return first


def _name_path(path: str, entries: Sequence[Listed]) -> str:
    """The path that a frame is named by: its file's, but for case, which the description's has."""
    listed = _normal(entries[0].path) if entries else path
    return listed if listed.casefold() == path.casefold() else path


def _normal(listed: str) -> str:
    return posixpath.normpath(listed.replace("\\", "/"))


def _frame_names(paths: Sequence[str]) -> list[str]:
    """File names where these are unique, else whole paths with the folders joined by `_`, or by as
    many of them as it takes.
    """
    names, separator = [Path(path).name for path in paths], ""
    while len(set(names)) < len(names):
        separator += "_"
        names = [separator.join(Path(path).parts) for path in paths]
    return names


def _at_its_size(root: Path, photo: Photograph) -> Photograph:
    """The photograph at its picture's size, where that is another size of the same view."""
    size = photo.height, photo.width
    try:
        height, width = image_size(root / photo.image_path, size)
    except InputError:  # said where the frame is read
        return photo
    if (height, width) == size or not same_view((height, width), size):
        return photo
    lens = photo.lens.resized(width / photo.width, height / photo.height)
    return replace(photo, height=height, width=width, lens=lens)


def _frame(root: Path, photo: Photograph, name: str, description: Path) -> Frame:
    pinhole, camera = pinhole_camera(photo, description)
    return PhotographLoader(
        root=root,
        name=name,
        camera=camera,
        image_path=photo.image_path,
        mask_path=photo.mask_path,
        depth=photo.depth,
        lens=None if photo.lens.is_pinhole else photo.lens,
        pinhole=pinhole,
        upright=photo.upright,
    ).frame()


def pinhole_camera(photo: Photograph, description: Path) -> tuple[Lens, Camera]:
    """The camera of a photograph once its lens is undone; InputError where it cannot be used."""
    lens = photo.lens
    if not all(np.isfinite([*lens.matrix.flat, *lens.distortion, lens.radial_r8])):
        raise InputError(f"{description}: the lens of {photo.image_path} is not finite; correct it")
    straight = _camera(photo, replace(lens, distortion=(), fisheye=False, radial_r8=0.0))
    # First, or the distortion would be blamed for a focal length of 0.
    require_sound(straight, photo.image_path, description)
    try:
        pinhole = lens.pinhole(photo.height, photo.width)
    except ValueError as error:
        raise InputError(
            f"{description}: {photo.image_path}: {error}; correct the lens or undistort beforehand"
        ) from None
    return pinhole, _camera(photo, pinhole)


def _camera(photo: Photograph, pinhole: Lens) -> Camera:
    return Camera(
        photo.world_to_cam.float(),
        torch.from_numpy(pinhole.matrix).float(),
        photo.height,
        photo.width,
    )
