"""Videos as photographs without cameras: sharp frames from places that differ.

A video is divided into stretches. One ends when most of what its first frame shows has moved by a
share of the picture or is no longer seen. Its sharpest frame is chosen among those that have moved
by less than half of that, so that two chosen frames in succession always differ.
"""

import hashlib
import json
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from extrap_train.config import MatcherConfig
from extrap_train.data.estimated_poses import find_pictures, read_unposed
from extrap_train.data.sequences import FrameSequence
from extrap_train.data.structure_from_motion import MIN_PICTURES
from extrap_train.data.video_files import frame_size, open_video
from extrap_train.errors import InputError
from extrap_train.store.cache import cache_entry, fill_entry, is_intact, seal
from extrap_train.store.digests import file_digest
from extrap_train.terminal import track

MAX_CHOSEN = 60
"""Of more stretches, as many are taken at even distances: the time of matching grows with the
square of their number."""
MAX_FRAMES = 100_000
"""Longer videos, of about an hour, are not of one scene."""
MOVED = 0.06
"""Median displacement that ends a stretch, as a share of the picture's diagonal."""
BLURRED, NEARBY = 1 / 3, 8
"""A frame is passed over if it is less than this share as sharp as the sharpest of as many frames
before and after it."""
_SIDE = 960
"""Longer side of the pictures in which sharpness and motion are measured, at most, in pixels."""
_MAX_FEATURES, _MIN_FEATURES = 400, 20
_FEATURE_QUALITY, _FEATURE_DISTANCE = 0.01, 8
_MAX_BACKWARD_ERROR = 1.0
"""In pixels, between a feature and where it comes to when it is tracked there and back."""
_JPEG_QUALITY = 95

Grey = UInt8[np.ndarray, "h w"]


def read_video(file: Path, poses: MatcherConfig | None = None) -> FrameSequence:
    """The capture of a video: some of its frames, kept in the cache, with estimated cameras.

    Frames are named by their number in the video, and placed by `poses`, as photographs are.
    InputError where the file is no video, shows fewer than three distinct views, or its cameras
    cannot be estimated.
    """
    settings = [
        *(MAX_CHOSEN, MOVED, BLURRED, NEARBY, _SIDE, _MAX_FEATURES, _MIN_FEATURES),
        *(_FEATURE_QUALITY, _FEATURE_DISTANCE, _MAX_BACKWARD_ERROR, _JPEG_QUALITY),
    ]
    content = json.dumps([settings, file_digest(file)])
    stored = cache_entry("videos", file.stem, hashlib.sha256(content.encode()).hexdigest())
    is_sound = partial(is_intact, part="images")
    if not is_sound(stored):
        with fill_entry(stored, is_sound, "frames of a video") as made:
            _write_chosen(file, made)
            seal(made, "images")
    return read_unposed(stored / "images", find_pictures(stored / "images"), file.stem, poses)


def choose_frames(frames: Iterable[Grey]) -> list[int]:
    """Numbers of the sharpest frame of each stretch, in order; frames have one size."""
    chosen: list[int] = []
    tracks: _Tracks | None = None
    sharpest = 0.0
    for number, frame, sharpness in _without_blurred(frames):
        moved = tracks.measure(frame) if tracks else np.inf
        if moved >= MOVED:
            start = _Tracks(frame)
            if len(start.points) < _MIN_FEATURES:  # a black frame, a wall
                continue
            tracks, moved, sharpest = start, 0.0, 0.0
            chosen.append(number)
        if moved < MOVED / 2 and sharpness > sharpest:
            chosen[-1], sharpest = number, sharpness
    return chosen


class _Tracks:
    """Where the features of a stretch's first frame are later."""

    def __init__(self, frame: Grey) -> None:
        found = cv2.goodFeaturesToTrack(frame, _MAX_FEATURES, _FEATURE_QUALITY, _FEATURE_DISTANCE)
        self.points = np.zeros((0, 1, 2), np.float32) if found is None else found
        self._frame, self._at = frame, self.points

    def measure(self, frame: Grey) -> float:
        """Median displacement as a share of the diagonal; lost features have gone infinitely far.

        Tracked from the first frame each time, from where they were before: errors do not add up.
        """
        there, found, _ = cv2.calcOpticalFlowPyrLK(
            self._frame, frame, self.points, self._at.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW
        )
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(frame, self._frame, there, there.copy())
        error = np.linalg.norm(back - self.points, axis=2)
        seen = (found == 1) & (found_back == 1) & (error < _MAX_BACKWARD_ERROR)
        self._at = np.where(seen[..., None], there, self._at)
        moved = np.where(seen, np.linalg.norm(there - self.points, axis=2), np.inf)
        return float(np.median(moved)) / float(np.hypot(*frame.shape))


def _without_blurred(frames: Iterable[Grey]) -> Iterator[tuple[int, Grey, float]]:
    """Number, frame and sharpness (variance of the Laplacian) of those that are not blurred."""
    window: deque[tuple[int, Grey, float]] = deque(maxlen=2 * NEARBY + 1)

    def is_sharp(sharpness: float) -> bool:
        return sharpness >= BLURRED * max(measured[2] for measured in window)

    for number, frame in enumerate(frames):
        window.append((number, frame, float(cv2.Laplacian(frame, cv2.CV_32F).var())))
        middle = window[max(len(window) - 1 - NEARBY, 0)]
        if number >= NEARBY and is_sharp(middle[2]):
            yield middle
    # The last frames have fewer after them.
    rest = list(window)[max(len(window) - NEARBY, 0) :]
    for number, frame, sharpness in rest:
        if is_sharp(sharpness):
            yield number, frame, sharpness


def _write_chosen(file: Path, made: Path) -> None:
    """Decode the video twice: to choose, and to write what was chosen."""
    chosen = _choose(file)
    if len(chosen) < MIN_PICTURES:
        raise InputError(
            f"{file}: shows {len(chosen)} distinct views, and estimating cameras takes at least "
            f"{MIN_PICTURES}; film a textured scene while walking around it"
        )
    if len(chosen) > MAX_CHOSEN:
        places = np.linspace(0, len(chosen) - 1, MAX_CHOSEN).round().astype(int)
        chosen = [chosen[place] for place in places]
    images = made / "images"
    images.mkdir()
    frames = track(_decode(file, chosen), "writing frames", len(chosen), "frames")
    for number, frame in frames:
        picture = Image.fromarray(np.ascontiguousarray(frame[..., ::-1]))
        picture.save(images / f"{number:06d}.jpg", quality=_JPEG_QUALITY, subsampling=0)


def _choose(file: Path) -> list[int]:
    with open_video(file) as video:
        total = int(min(max(video.get(cv2.CAP_PROP_FRAME_COUNT), 1), MAX_FRAMES))
    frames = track(_decode(file), "choosing frames", total, "frames")
    return choose_frames(_small_grey(frame) for _, frame in frames)


def _decode(
    file: Path, wanted: Sequence[int] | None = None
) -> Iterator[tuple[int, UInt8[np.ndarray, "h w 3"]]]:
    """Number and frame (BGR) of each frame, or of those that are wanted."""
    with open_video(file) as video:
        size, number = frame_size(video), 0
        while (wanted is None or number <= wanted[-1]) and video.grab():
            if number == MAX_FRAMES:
                raise InputError(f"{file}: has more than {MAX_FRAMES:,} frames; cut the video")
            if wanted is None or number in wanted:
                found, frame = video.retrieve()
                if not found or frame.shape != (*size, 3):
                    raise InputError(
                        f"{file}: frame {number} is not of {size[0]} x {size[1]} pixels (height x "
                        "width) as the file says; convert the file"
                    )
                yield number, frame
            number += 1
    if number == 0:
        raise InputError(f"{file}: holds no frame that can be decoded; restore or convert the file")


def _small_grey(frame: UInt8[np.ndarray, "h w 3"]) -> Grey:
    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    scale = _SIDE / max(grey.shape)
    if scale >= 1:
        return grey
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
