"""Single frames of video files from outside."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from extrap_train.data.paths import require_file
from extrap_train.errors import InputError


def read_video_frame(
    path: Path, seconds: float, size: tuple[int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """The frame that is shown at a time after the start, as colours; grey ones three times.

    `size` is (height, width) after the rotation that the file asks for. InputError for other sizes,
    for files that are neither MP4 nor Matroska, and where no frame can be decoded.
    """
    require_file(path)
    with path.open("rb") as file:
        start = file.read(8)
    if start[4:] != b"ftyp" and start[:4] != b"\x1a\x45\xdf\xa3":
        raise InputError(f"{path}: is neither an MP4 nor a Matroska video; restore the file")
    video = cv2.VideoCapture(str(path.absolute()), cv2.CAP_FFMPEG)
    try:
        sides = [int(video.get(p)) for p in (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH)]
        if tuple(sides) != size:
            raise InputError(
                f"{path}: has frames of {sides[0]} x {sides[1]} pixels (height x width), not of "
                f"{size[0]} x {size[1]}; restore the file"
            )
        video.set(cv2.CAP_PROP_POS_MSEC, 1000 * seconds)
        found, frame = video.read()
    finally:
        video.release()
    if not found or frame.shape != (*size, 3):
        raise InputError(f"{path}: has no frame at {seconds:.3f} s; restore the file")
    return np.ascontiguousarray(frame[..., ::-1])
