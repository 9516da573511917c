"""Captures on disk: a sequence of posed frames, read lazily, whatever the format they came in."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from extrap_train.data.depth_files import DepthFile
from extrap_train.data.image_files import read_photograph
from extrap_train.data.paths import require_file
from extrap_train.geometry.cuts import Cut
from extrap_train.geometry.lens import Lens, undistort
from extrap_train.views import Camera, View, WholePhotograph

NO_CATEGORY = "scene"
"""What stands for a category where a capture has none."""


@runtime_checkable
class Load(Protocol):
    """Reads a photograph."""

    def __call__(self, *, depth: bool = True) -> View:
        """Image and mask at full resolution, and what depth the data set has unless not wanted:
        then its file is not opened. Raises InputError that names the file.
        """
        ...


@dataclass(frozen=True)
class Frame:
    """One posed photograph that has not been read yet."""

    name: str
    """Unique within its sequence; the image's file name."""
    camera: Camera
    """At the resolution of the image on disk."""
    has_depth: bool
    has_mask: bool
    load: Load
    files: tuple[Path, ...]
    """What `load` reads; none where it renders."""
    reading: str = ""
    """What else decides about what `load` returns, in words: the lens that it undoes, the unit of
    depth files."""
    path: str = ""
    """Of the photograph, as `WholePhotograph.path`."""


@dataclass(frozen=True, slots=True)
class Photograph:
    """One photograph's files; a dataclass and no closure, so that it can be sent to workers."""

    root: Path
    name: str
    camera: Camera
    """Camera of the undistorted photograph, or of the cut."""
    image_path: str
    mask: Path | None = None
    """As it is opened, the root included."""
    depth: DepthFile | None = None
    lens: Lens | None = None
    """To be undone; None for a pinhole camera's photograph."""
    cut: Cut | None = None
    """What of the photograph is the frame, if not the whole; then `lens` is None."""
    upright: bool = False
    """Whether the camera holds the photograph as its EXIF orientation turns it."""

    def frame(self) -> Frame:
        """The photograph as a frame that has not been read yet."""
        parts = [str(part) for part in (self.lens, self.cut) if part]
        parts.append(f"depth in {self.depth.scale if self.depth else None}")
        parts += ["upright"] if self.upright else []
        depth = (self.depth.path, self.depth.mask_path) if self.depth else ()
        files = [self.root / self.image_path, *([self.mask] if self.mask else ())]
        return Frame(
            name=self.name,
            camera=self.camera,
            has_depth=self.depth is not None,
            has_mask=self.mask is not None,
            load=self.load,
            files=(*files, *(self.root / file for file in depth if file)),
            reading=", ".join(parts),
            path=self._path,
        )

    @property
    def _path(self) -> str:
        """Of the frame: a cut is named as if it were a file beside its picture."""
        return (
            str(PurePosixPath(self.image_path).with_name(self.name))
            if self.cut
            else self.image_path
        )

    def load(self, *, depth: bool = True) -> View:
        """See `Load`."""
        whole = self.cut or self.camera
        size = whole.height, whole.width
        image, mask = read_photograph(self.root / self.image_path, size, self.mask, self.upright)
        found = self.depth.read(self.root, size) if depth and self.depth else None
        return View(
            image=self._straighten(image.permute(1, 2, 0)).permute(2, 0, 1).contiguous(),
            camera=self.camera,
            depth=None if found is None else self._straighten(found, nearest=True),
            mask=None if mask is None else self._straighten(mask),
            name=self.name,
            photograph=WholePhotograph(self._path, self.camera),
        )

    def _straighten(self, picture: Tensor, nearest: bool = False) -> Tensor:
        if self.cut is not None:
            return torch.from_numpy(self.cut.extract(picture.numpy(), nearest))
        if self.lens is None:
            return picture
        pinhole = self.lens.pinhole(self.camera.height, self.camera.width)
        return torch.from_numpy(undistort(picture.numpy(), self.lens, pinhole, nearest))


@dataclass(frozen=True)
class PointFile:
    """A file of points as a description lists it, which need not be there."""

    root: Path
    path: str
    """Below the root; it has passed `check_relative`."""

    def find(self) -> Path | None:
        """The file, None where there is none."""
        file = self.root / self.path
        return require_file(file) if file.exists() else None


@dataclass(frozen=True)
class FrameSequence:
    """A capture of one scene."""

    category: str
    name: str
    frames: Sequence[Frame]
    """In the order in which they were taken."""
    left_out: tuple[str, ...] = ()
    """A reason for each frame that the capture lists and that is left out."""
    listed: tuple[str, ...] = ()
    """Names of all that the capture's description lists, those without a picture and those that are
    left out included, in order; empty where a capture has no such list."""
    viewpoint_quality: float | None = None
    """CO3D's score of its camera poses; None where the capture has none."""
    point_cloud_quality: float | None = None
    point_cloud: PointFile | None = None
    poses: str = ""
    """Where its cameras come from, in words."""
