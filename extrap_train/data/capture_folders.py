"""Captures of one's own: a folder per category, and in it, one entry per capture.

An entry is whatever `scene=` takes as a path: a folder, an archive or a video.
"""

import logging
from dataclasses import replace
from pathlib import Path

from extrap_train.config import MatcherConfig
from extrap_train.data.archives import is_archive
from extrap_train.data.estimated_poses import find_pictures
from extrap_train.data.scene_spec import open_scene
from extrap_train.data.sequences import FrameSequence
from extrap_train.data.video_files import is_video
from extrap_train.errors import InputError

log = logging.getLogger(__name__)


def require_category(root: Path, category: str) -> None:
    """InputError where the folder of the category is missing or holds no capture."""
    if not (root / category).is_dir():
        if root.name == category and root.is_dir():
            raise InputError(f"{root}: is the category's own folder; give the one above it")
        present = ", ".join(sorted(path.name for path in _visible(root) if path.is_dir()))
        raise InputError(
            f"{root}: has no folder {category}; put the captures in {root / category}/NAME "
            f"(folders there: {present or 'none'})"
        )
    if _entries(root / category):
        return
    if find_pictures(root / category):
        raise InputError(
            f"{root / category}: holds photographs, but should hold one folder per capture; move "
            f"them to {root / category}/NAME"
        )
    raise InputError(f"{root / category}: holds no folder, archive or video of a capture; add some")


def read_category(
    root: Path, category: str, poses: MatcherConfig | None = None, *, needs_depth: bool = False
) -> list[FrameSequence]:
    """The captures of a category, by name; cameras are estimated where there are none.

    A capture that cannot be read is left out with a warning. InputError where all are. For `poses`
    and `needs_depth`, see `open_scene`.
    """
    require_category(root, category)
    found, faults = [], []
    for entry in _entries(root / category):
        try:
            sequence = open_scene(str(entry), poses=poses, needs_depth=needs_depth)
        except InputError as fault:
            log.warning("%s is left out: %s", entry, fault)
            faults.append(str(fault))
            continue
        name = entry.name if entry.is_dir() else entry.stem
        found.append(replace(sequence, category=category, name=name))
    if not found:
        raise InputError(f"{root / category}: none of its captures can be read; {faults[0]}")
    names = [sequence.name for sequence in found]
    if double := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"{root / category}: two captures are called {double}; rename one")
    return found


def _entries(folder: Path) -> list[Path]:
    """What may be captures, by name."""
    return [
        path
        for path in _visible(folder)
        if path.is_dir() or (path.is_file() and (is_archive(path) or is_video(path)))
    ]


def _visible(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder of your captures")
    return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
