"""Reads a posed photograph with its mask and depth, and undoes its lens."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.data.images import (
    known_depth,
    read_depth,
    read_depth_mask,
    read_photograph,
    read_sixteen_bit,
)
from extrap_train.data.paths import require_file
from extrap_train.data.sequences import Frame
from extrap_train.geometry.lens import Lens, undistort
from extrap_train.views import Camera, View


@dataclass(frozen=True, slots=True)
class DepthFile:
    """A depth map on disk; paths are relative to the data set's root."""

    path: str
    scale: float
    """Scene units per unit of the file."""
    mask_path: str | None = None
    """Of a picture that shows which of the depths to trust."""
    is_half_float: bool = False
    """Whether the 16 bits of its pixels are CO3D's float16, no whole numbers."""


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

    def frame(self) -> Frame:
        """The photograph as a frame that has not been read yet."""
        parts = [str(self.lens)] if self.lens else []
        parts.append(f"depth in {self.depth.scale if self.depth else None}")
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
        image, mask = read_photograph(image_path, size, mask_path)
        found = self._read_depth(self.depth, size) if depth and self.depth else None
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

    def _read_depth(self, file: DepthFile, size: tuple[int, int]) -> Float[Tensor, "h w"]:
        path = require_file(self.root / file.path)
        if file.is_half_float:
            depth = known_depth(read_sixteen_bit(path, size).view(np.float16), file.scale, path)
        else:
            depth = read_depth(path, size, file.scale)
        if file.mask_path:
            depth *= read_depth_mask(require_file(self.root / file.mask_path), size)
        return depth

    def _straighten(self, picture: Tensor, nearest: bool = False) -> Tensor:
        if self.lens is None or self.pinhole is None:
            return picture
        return torch.from_numpy(undistort(picture.numpy(), self.lens, self.pinhole, nearest))
