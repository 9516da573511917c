"""Captures on disk: a sequence of posed frames, read lazily, whatever the format they came in."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from extrap_train.data.paths import require_file
from extrap_train.views import Camera, View


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


@dataclass(frozen=True)
class PointCloud:
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
    point_cloud: PointCloud | None = None
