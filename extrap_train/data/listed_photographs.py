"""Photographs that a description lists with their cameras, whatever its format: from the paths as
they stand there to a sequence.
"""

import logging
import posixpath
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.data.camera_check import PoseConvention, find_pose_fault, require_sound
from extrap_train.data.depth_files import DepthFile
from extrap_train.data.image_files import image_size, same_view
from extrap_train.data.listed_files import (
    PICTURE_SUFFIXES,
    ListedFiles,
    MaskFiles,
    counting_order,
    normal_path,
)
from extrap_train.data.sequences import NO_CATEGORY, FrameSequence, Photograph, PointFile
from extrap_train.errors import InputError
from extrap_train.geometry.cuts import Cut, Equirectangular, cuts_of
from extrap_train.geometry.lens import Lens
from extrap_train.views import Camera, stack_poses

MAX_FRAMES = 100_000
"""Most frames of a capture; more are not a capture of one scene."""
MAX_UNEVEN = 0.01
"""Deviation of a panorama's sides from 2 : 1 that is rounding, as a share of its width."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ListedPhotograph:
    """What a description says of one picture; paths are relative to the capture's folder."""

    image_path: str
    height: int
    width: int
    lens: Lens | Equirectangular
    world_to_cam: Float[Tensor, "4 4"]
    depth: DepthFile | None = None
    mask_path: str | None = None
    upright: bool = False


@dataclass(frozen=True)
class Listed:
    """An entry of a description."""

    path: str
    """Path of the picture, as it is listed; it has passed `check_relative`."""
    describe: Callable[[str], ListedPhotograph]
    """The photograph, by the path at which the picture was found; InputError where the entry cannot
    be used."""


def sequence_of_photographs(
    files: ListedFiles,
    name: str,
    listed: Sequence[Listed],
    description: Path,
    convention: PoseConvention,
    unusable: Sequence[str],
    point_cloud: PointFile | None = None,
) -> FrameSequence:
    """A sequence of the photographs below `files.root`, in the `counting_order` of their paths.

    `description` is the file that lists them; masks that it does not name are found by `MaskFiles`.
    `unusable` holds the reasons why further entries name no picture. Entries without a picture, and
    those that cannot be used or contradict each other, are left out with one warning each kind.
    Raises InputError where none is left, or the cameras can see nothing in common.
    """
    count = len(listed) + len(unusable)
    if count > MAX_FRAMES:
        raise InputError(f"{description}: lists more than {MAX_FRAMES:,} pictures; split it")
    pictures = _find_pictures(files, listed, description)
    names = _frame_names([_name_path(path, entries) for path, entries in pictures])
    photographs: list[Photograph] = []
    all_names, left_out, resized = [], [*unusable], []
    masks = MaskFiles(files.root, [path for path, _ in pictures])
    for (path, entries), frame_name in zip(pictures, names, strict=True):
        all_names.append(frame_name)
        if not entries:
            continue
        try:
            annotated = _describe(path, entries, description)
            photo = _at_its_size(files.root, annotated)
            mask = files.root / photo.mask_path if photo.mask_path else masks.find(path)
            shown = _photographs(files.root, photo, frame_name, mask, description)
        except InputError as error:
            left_out.append(str(error))
            continue
        photographs += shown
        all_names[-1:] = [photograph.name for photograph in shown]
        if photo is not annotated:
            resized.append(f"{path} has {photo.height} x {photo.width} pixels (height x width)")
    masks.require_distinct()
    if not photographs:
        raise InputError(left_out[0])
    masks.warn_of_missing()
    if left_out:
        log.warning("%d of %d frames are left out: %s", len(left_out), count, left_out[0])
    if resized:
        say = "%s: %d pictures have another size than it says: their lenses are scaled (%s)"
        log.warning(say, description, len(resized), resized[0])
    _check_together(photographs, all_names, convention, description)
    return FrameSequence(
        NO_CATEGORY,
        name,
        tuple(photograph.frame() for photograph in photographs),
        left_out=tuple(left_out),
        listed=tuple(all_names),
        point_cloud=point_cloud,
        poses=str(description),
    )


def _check_together(
    photographs: Sequence[Photograph],
    names: Sequence[str],
    convention: PoseConvention,
    description: Path,
) -> None:
    """InputError where two frames have one name, or the cameras see nothing in common."""
    if len(set(names)) < len(names):
        ((twice, _),) = Counter(names).most_common(1)
        raise InputError(f"{description}: two frames are called {twice}; rename a picture")
    # Of cuts, the one straight ahead stands where its picture's camera does.
    poses = stack_poses([p.camera for p in photographs if not (p.cut and p.cut.yaw_deg)])
    is_panorama = any(p.cut and isinstance(p.cut.source, Equirectangular) for p in photographs)
    if fault := find_pose_fault(poses, convention, all_around=is_panorama):
        raise InputError(f"{description}: {fault}")


def _photographs(
    root: Path, photo: ListedPhotograph, name: str, mask: Path | None, description: Path
) -> list[Photograph]:
    """The frame that a picture is, or the cuts of one that sees too much for that: those of
    `1.jpg` are called `1@000.jpg`, `1@060.jpg` …
    """
    lens = photo.lens
    if isinstance(lens, Lens):
        _require_sound_lens(photo, lens, description)
    else:
        _require_sound_panorama(photo, f"{description}: {photo.image_path}")
    # Depth along a fisheye's axis is none along that of a cut.
    cuts = () if photo.depth else cuts_of(lens, photo.height, photo.width)
    whole = Photograph(
        root=root,
        name=name,
        camera=_cut_camera(photo, cuts[0]) if cuts else pinhole_camera(photo, description),
        image_path=photo.image_path,
        mask=mask,
        depth=photo.depth,
        lens=lens if isinstance(lens, Lens) and not cuts and not lens.is_pinhole else None,
        upright=photo.upright,
    )
    if not cuts:
        return [whole]
    require_sound(whole.camera, photo.image_path, description)
    stem, suffix = posixpath.splitext(name)
    return [
        replace(
            whole, name=f"{stem}@{cut.yaw_deg:03d}{suffix}", camera=_cut_camera(photo, cut), cut=cut
        )
        for cut in cuts
    ]


def _require_sound_panorama(photo: ListedPhotograph, where: str) -> None:
    if abs(photo.width - 2 * photo.height) > MAX_UNEVEN * photo.width:
        raise InputError(
            f"{where} is a panorama of {photo.width} x {photo.height} pixels, not twice as wide as "
            "high; pad it to 360 by 180 degrees"
        )
    if photo.depth:
        raise InputError(f"{where} is a panorama, whose depth cannot be read; remove its depth")


def _cut_camera(photo: ListedPhotograph, cut: Cut) -> Camera:
    cut_from_picture = torch.eye(4, dtype=torch.float64)
    cut_from_picture[:3, :3] = torch.from_numpy(cut.cut_from_picture)
    world_to_cut = cut_from_picture @ photo.world_to_cam.double()
    return Camera(world_to_cut.float(), torch.from_numpy(cut.matrix).float(), cut.side, cut.side)


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
            entries.setdefault(normal_path(entry.path), [])
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
    return sorted(entries.items(), key=lambda entry: counting_order(entry[0]))


def _describe(path: str, entries: Sequence[Listed], description: Path) -> ListedPhotograph:
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
    listed = normal_path(entries[0].path) if entries else path
    return listed if listed.casefold() == path.casefold() else path


def _frame_names(paths: Sequence[str]) -> list[str]:
    """File names where these are unique, else whole paths with the folders joined by `_`, or by as
    many of them as it takes.
    """
    names, separator = [Path(path).name for path in paths], ""
    while len(set(names)) < len(names):
        separator += "_"
        names = [separator.join(Path(path).parts) for path in paths]
    return names


def _at_its_size(root: Path, photo: ListedPhotograph) -> ListedPhotograph:
    """The photograph at its picture's size, where that is another size of the same view."""
    size = photo.height, photo.width
    try:
        height, width = image_size(root / photo.image_path, size)
    except InputError:  # said where the frame is read
        return photo
    if (height, width) == size or not same_view((height, width), size):
        return photo
    lens = photo.lens
    if isinstance(lens, Lens):
        lens = lens.resized(width / photo.width, height / photo.height)
    return replace(photo, height=height, width=width, lens=lens)


def pinhole_camera(photo: ListedPhotograph, description: Path) -> Camera:
    """The camera of a photograph once its lens is undone; InputError where it cannot be used."""
    lens = photo.lens
    if not isinstance(lens, Lens):
        raise InputError(
            f"{description}: {photo.image_path} is a panorama, and here only a perspective camera "
            "can be used; give its lens"
        )
    # First, or the distortion would be blamed for a focal length of 0.
    _require_sound_lens(photo, lens, description)
    try:
        pinhole = lens.pinhole(photo.height, photo.width)
    except ValueError as error:
        raise InputError(
            f"{description}: {photo.image_path}: {error}; correct the lens or undistort beforehand"
        ) from None
    return _camera(photo, pinhole)


def _require_sound_lens(photo: ListedPhotograph, lens: Lens, description: Path) -> None:
    if not all(np.isfinite([*lens.matrix.flat, *lens.distortion, lens.radial_r8])):
        raise InputError(f"{description}: the lens of {photo.image_path} is not finite; correct it")
    straight = _camera(photo, replace(lens, distortion=(), fisheye=False, radial_r8=0.0))
    require_sound(straight, photo.image_path, description)


def _camera(photo: ListedPhotograph, pinhole: Lens) -> Camera:
    return Camera(
        photo.world_to_cam.float(),
        torch.from_numpy(pinhole.matrix).float(),
        photo.height,
        photo.width,
    )
