"""One frame of a uCO3D video: picture and mask at a time, depth by a number."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.data.image_files import MAX_PIXELS, nearest_pixels, same_view
from extrap_train.data.paths import require_file
from extrap_train.data.sequences import Frame
from extrap_train.data.video_files import read_video_frame
from extrap_train.errors import InputError
from extrap_train.geometry.lens import Lens, undistort
from extrap_train.views import Camera, View, WholePhotograph


@dataclass(frozen=True, slots=True)
class VideoFrame:
    """One frame of a sequence; paths are below the root."""

    root: Path
    number: int
    seconds: float
    camera: Camera
    """Of the undistorted frame."""
    lens: Lens | None
    video: str
    mask_video: str | None
    depths: str | None
    depth_scale: float | None

    @property
    def name(self) -> str:
        """As CO3D calls it."""
        return f"frame{self.number:06d}"

    @property
    def path(self) -> str:
        """Beside the video, as if the frame were a file there."""
        return f"{Path(self.video).parent.as_posix()}/{self.name}"

    def frame(self) -> Frame:
        """The frame as others see it."""
        files = (self.video, self.mask_video, self.depths)
        return Frame(
            name=self.name,
            camera=self.camera,
            has_depth=self.depths is not None,
            has_mask=self.mask_video is not None,
            load=self.load,
            files=tuple(self.root / file for file in files if file),
            reading=f"{self.seconds} s, {self.lens}, depth in {self.depth_scale}",
            path=self.path,
        )

    def load(self, *, depth: bool = True) -> View:
        """See `extrap_train.data.sequences.Load`."""
        image = self._straighten(self.video)
        mask = self._straighten(self.mask_video)[..., 0] if self.mask_video else None
        if mask is not None and not mask.any():
            raise InputError(f"{self.root / str(self.mask_video)}: {self.name}: its mask is empty")
        return View(
            image=image.permute(2, 0, 1).contiguous(),
            camera=self.camera,
            depth=self._read_depth() if depth and self.depths else None,
            mask=mask,
            name=self.name,
            photograph=WholePhotograph(self.path, self.camera),
        )

    def _straighten(self, video: str) -> Float[Tensor, "h w 3"]:
        size = self.camera.height, self.camera.width
        picture = read_video_frame(self.root / video, self.seconds, size)
        if self.lens is not None:
            (fx, _, cx), (_, fy, cy), _ = self.camera.intrinsics.tolist()
            picture = undistort(picture, self.lens, Lens(fx, fy, cx, cy))
        return torch.from_numpy(picture).float().div_(255)

    def _read_depth(self) -> Float[Tensor, "h w"]:
        """In the unit of the cameras; 0 where it is unknown."""
        file, size = (
            require_file(self.root / str(self.depths)),
            (self.camera.height, self.camera.width),
        )
        scale = self.depth_scale if self.depth_scale is not None else 1.0
        depth = nearest_pixels(_read_h5_map(file, str(self.number + 1), size), size) * scale
        depth[~(np.isfinite(depth) & (depth > 0))] = 0
        if not depth.any():
            raise InputError(
                f"{file}: the depth of {self.name} is zero everywhere; use depth=stereo"
            )
        return torch.from_numpy(depth.astype(np.float32))


def _read_h5_map(file: Path, key: str, size: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    """A map of `size`'s shape from an HDF5 file, of which no link to other files is followed."""
    try:
        import h5py
    except ImportError:
        raise InputError(
            f'{file}: pip install "extrap-train[uco3d]" to read it, or use depth=stereo'
        ) from None
    try:
        with h5py.File(file, "r") as content:
            is_own = isinstance(content.get(key, getlink=True), h5py.HardLink)
            stored: Any = content[key] if is_own else None
            is_map = isinstance(stored, h5py.Dataset) and not (stored.is_virtual or stored.external)
            if not is_map or stored.dtype.kind not in "fiu" or not _fits(stored.shape, size):
                raise InputError(f"{file}: has no map of {size} called {key}; restore the file")
            return np.asarray(stored[()], np.float32)
    except InputError:
        raise
    except (OSError, RuntimeError, KeyError, TypeError, ValueError):
        raise InputError(
            f"{file}: is truncated or damaged; restore it or use depth=stereo"
        ) from None


def _fits(shape: tuple[int, ...], size: tuple[int, int]) -> bool:
    return len(shape) == 2 and 0 < math.prod(shape) <= MAX_PIXELS and same_view(shape, size)
