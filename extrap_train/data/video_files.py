"""Video files from outside, and single frames of them."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from extrap_train.data.image_files import MAX_PIXELS, MAX_SIDE
from extrap_train.data.paths import require_file
from extrap_train.errors import InputError

_QUICKTIME_ATOMS = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
"""What an MP4 or MOV file may begin with, after four bytes of length."""
_MATROSKA = b"\x1a\x45\xdf\xa3"

# FFmpeg and OpenCV print what they think of damaged files; this module reports what matters.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


def is_video(path: Path) -> bool:
    """Whether a file is, by its content, MP4, MOV, AVI, Matroska or WebM; no playlist is."""
    try:
        with require_file(path).open("rb") as file:
            start = file.read(12)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the file") from None
    is_avi = start[:4] == b"RIFF" and start[8:] == b"AVI "
    return start[4:8] in _QUICKTIME_ATOMS or start[:4] == _MATROSKA or is_avi


@contextmanager
def open_video(path: Path) -> Iterator[cv2.VideoCapture]:
    """A video whose frames OpenCV decodes, turned as the file asks for.

    InputError for files that are none (`is_video`), that cannot be decoded, or whose frames have
    more than `MAX_PIXELS`.
    """
    if not is_video(path):
        raise InputError(
            f"{path}: is not a video (MP4, MOV, AVI, Matroska or WebM); restore or convert the file"
        )
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    video = cv2.VideoCapture(str(path.absolute()), cv2.CAP_FFMPEG)
    cv2.utils.logging.setLogLevel(level)
    try:
        if not video.isOpened():
            raise InputError(
                f"{path}: is a truncated video, or one of a kind that OpenCV cannot decode; "
                "restore the file or convert it to H.264"
            )
        height, width = frame_size(video)
        if max(height, width) > MAX_SIDE or height * width > MAX_PIXELS:
            raise InputError(
                f"{path}: has frames of {height} x {width} pixels (height x width), and only those "
                f"of at most {MAX_PIXELS:,} can be read; scale the video down"
            )
        yield video
    finally:
        video.release()


def frame_size(video: cv2.VideoCapture) -> tuple[int, int]:
    """(height, width) in pixels that the file states, once turned."""
    height, width = cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH
    return int(video.get(height)), int(video.get(width))


def read_video_frame(
    path: Path, seconds: float, size: tuple[int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """The frame that is shown at a time after the start, as colours; grey ones three times.

    `size` is (height, width) after the rotation that the file asks for. InputError for other sizes,
    for files that are no videos (`open_video`), and where no frame can be decoded.
    """
    with open_video(path) as video:
        sides = frame_size(video)
        if sides != size:
            raise InputError(
                f"{path}: has frames of {sides[0]} x {sides[1]} pixels (height x width), not of "
                f"{size[0]} x {size[1]}; restore the file"
            )
        video.set(cv2.CAP_PROP_POS_MSEC, 1000 * seconds)
        found, frame = video.read()
    if not found or frame.shape != (*size, 3):
        raise InputError(f"{path}: has no frame at {seconds:.3f} s; restore the file")
    return np.ascontiguousarray(frame[..., ::-1])
