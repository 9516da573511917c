"""uCO3D downloads: videos of objects, with cameras in one SQLite file.

The layout is that of github.com/facebookresearch/uco3d: `metadata.sqlite` with the tables
`sequence_annots` and `frame_annots`, whose matrices are packed as floats of 32 bits, and per
sequence a video, a video of masks, and an HDF5 file of depth. Cameras are PyTorch3D's in isotropic
NDC, whatever `_viewpoint_intrinsics_format` says: uCO3D's own reader ignores it. Depth belongs to
the undistorted picture as OpenCV crops it, so that ours is undistorted to that one.
"""

import logging
import math
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float

from extrap_train.data.camera_check import require_sound
from extrap_train.data.image_files import MAX_PIXELS
from extrap_train.data.paths import check_relative, require_file
from extrap_train.data.sequences import Frame, FrameSequence
from extrap_train.data.uco3d.video_frame import VideoFrame
from extrap_train.errors import InputError, did_you_mean
from extrap_train.geometry.foreign_cameras import Viewpoint, camera_from_viewpoint
from extrap_train.geometry.lens import Lens
from extrap_train.views import Camera

METADATA = "metadata.sqlite"
_VIEWPOINT = {
    "_viewpoint_R": (3, 3),
    "_viewpoint_T": (3,),
    "_viewpoint_focal_length": (2,),
    "_viewpoint_principal_point": (2,),
    "_viewpoint_colmap_distortion_coeffs": (12,),
}
_FRAME_COLUMNS = ("frame_number", "frame_timestamp", "_image_size", "_depth_scale_adjustment")
_SEQUENCE_COLUMNS = (
    *("sequence_name", "category", "_video_path", "_mask_video_path", "_depth_video_path"),
    "_reconstruction_quality_viewpoint",
)
_THIN_PRISM = 4
"""Of OpenCV's twelve coefficients, the last ones, which our lenses do not have."""

log = logging.getLogger(__name__)


def list_categories(root: Path) -> list[str]:
    """The categories of a uCO3D download; InputError where there is none."""
    rows = _query(root, "SELECT DISTINCT category FROM sequence_annots ORDER BY category")
    return [str(category) for (category,) in rows if category]


def require_category(root: Path, category: str) -> None:
    """InputError where the download does not have the category."""
    known = list_categories(root)
    if category not in known:
        raise InputError(f"{root}: has no category {category!r}; {did_you_mean(category, known)}")


def read_category(root: Path, category: str) -> list[FrameSequence]:
    """The sequences of a category whose videos are there, by name."""
    require_category(root, category)
    found = [*_sequences(root, "category = ?", category)]
    if not found:
        raise InputError(f"{root}: has no video of {category}; download `rgb_videos` of it")
    return found


def read_sequence(root: Path, name: str) -> FrameSequence:
    """One sequence by its name; InputError where it or its video is not there."""
    found = next(_sequences(root, "sequence_name = ?", name), None)
    if found is None:
        raise InputError(f"{root}: has no sequence {name!r} with a video; check its name")
    if not found.frames:
        raise InputError(f"{root}: none of the frames of {name} can be used: {found.left_out[0]}")
    return found


def _sequences(root: Path, condition: str, value: str) -> Iterator[FrameSequence]:
    columns = ", ".join(_SEQUENCE_COLUMNS)
    rows = _query(
        root, f"SELECT {columns} FROM sequence_annots WHERE {condition} ORDER BY 1", value
    )
    missing = []
    for name, category, *paths, quality in rows:
        files = [check_relative(str(path), root / METADATA) if path else None for path in paths]
        video, mask, depth = (path if path and (root / path).is_file() else None for path in files)
        if video is None:
            missing.append(name)
            continue
        frames, left_out = _frames(root, name, video, mask, depth)
        if left_out:
            log.warning("%s: %d frames are left out: %s", name, len(left_out), left_out[0])
        yield FrameSequence(
            category=str(category),
            name=str(name),
            frames=frames,
            left_out=left_out,
            viewpoint_quality=quality if isinstance(quality, float) else None,
        )
    if missing:
        log.warning(
            "%s: %d sequences have no video, the first is %s", root, len(missing), missing[0]
        )


def _frames(
    root: Path, name: str, video: str, mask: str | None, depth: str | None
) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """The frames of a sequence in order, and why others are left out."""
    columns = ", ".join([*_FRAME_COLUMNS, *_VIEWPOINT])
    rows = _query(
        root, f"SELECT {columns} FROM frame_annots WHERE sequence_name = ? ORDER BY 1", name
    )
    sound, left_out = [], []
    for number, seconds, size, scale, *viewpoint in rows:
        where = f"{name} frame {number}"
        try:
            height, width = _unpack(size, "<i4", (2,)).tolist()
            if not (height > 0 and width > 0 and height * width <= MAX_PIXELS):
                raise ValueError(f"a size of {height} x {width}")
            if not (isinstance(seconds, float) and 0 <= seconds < math.inf):
                raise ValueError(f"a time of {seconds}")
            if not (isinstance(number, int) and isinstance(scale, float | None)):
                raise ValueError(f"a number of {number!r}, a scale of depth of {scale!r}")
            values = [
                _unpack(v, "<f4", s) for v, s in zip(viewpoint, _VIEWPOINT.values(), strict=True)
            ]
            camera, lens = _undistorted(values, height, width)
            require_sound(camera, where, root / METADATA)
        except InputError as error:
            left_out.append(str(error))
        except (TypeError, ValueError, cv2.error) as error:
            reason = " ".join(str(error).split())
            left_out.append(f"{root / METADATA}: {where} cannot be used ({reason})")
        else:
            one = VideoFrame(root, number, seconds, camera, lens, video, mask, depth, scale)
            sound.append(one.frame())
    return tuple(sound), tuple(left_out)


def _undistorted(
    values: Sequence[Float[np.ndarray, "..."]], height: int, width: int
) -> tuple[Camera, Lens | None]:
    """The camera of the undistorted frame, and the lens that is undone."""
    *others, distortion = values
    rotation, translation, focal, principal = (
        torch.from_numpy(other.astype(np.float64)) for other in others
    )
    viewpoint = Viewpoint(rotation, translation, focal, principal, "ndc_isotropic")
    camera = camera_from_viewpoint(viewpoint, height, width)
    lens = None
    if distortion.any():
        if not np.isfinite(distortion).all() or distortion[-_THIN_PRISM:].any():
            raise ValueError("a distortion that is not finite or that of a thin prism")
        (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
        lens = Lens(fx, fy, cx, cy, tuple(distortion[:-_THIN_PRISM].tolist()))
        centre = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        size = (width, height)
        cropped, _ = cv2.getOptimalNewCameraMatrix(
            lens.matrix - centre, np.array(lens.distortion), size, 0.0, size
        )
        camera = replace(camera, intrinsics=torch.from_numpy(cropped + centre))
    return replace(
        camera, world_to_cam=camera.world_to_cam.float(), intrinsics=camera.intrinsics.float()
    ), lens


def _unpack(value: Any, kind: str, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """A tuple as uCO3D's columns hold it; ValueError where it is none of that shape."""
    if not isinstance(value, bytes) or len(value) != 4 * math.prod(shape):
        raise ValueError(f"an entry that is not {shape} numbers")
    return np.frombuffer(value, kind).reshape(shape)


def _query(root: Path, question: str, *values: str) -> list[tuple[Any, ...]]:
    file = require_file(root / METADATA)
    try:
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro", uri=True)) as opened:
            opened.execute("PRAGMA trusted_schema = OFF")
            return opened.execute(question, values).fetchall()
    except (sqlite3.Error, UnicodeError) as error:
        raise InputError(f"{file}: is not uCO3D's metadata ({error}); restore the file") from None
