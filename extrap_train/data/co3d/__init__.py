"""CO3D downloads, first and second release, and everything else written in their layout.

Images, masks and depth maps are read when a frame is; what is read at once are the annotations of
one category. Depth is z in PyTorch3D's units, which are ours.
"""

import gc
import logging
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from extrap_train.data.co3d.annotations import (
    BadEntry,
    FrameAnnotation,
    SequenceAnnotation,
    read_frame_annotations,
    read_sequence_annotations,
)
from extrap_train.data.co3d.frame_columns import Co3dFrames, is_blackened
from extrap_train.data.sequences import Frame, FrameSequence, PointFile
from extrap_train.errors import InputError, did_you_mean

FRAME_ANNOTATIONS = "frame_annotations.jgz"
SEQUENCE_ANNOTATIONS = "sequence_annotations.jgz"

_ENTRIES_AT_A_TIME = 4096
"""Parsed JSON takes twenty times the room of what is kept of it."""

log = logging.getLogger(__name__)


def list_categories(root: Path) -> list[str]:
    """The categories that a CO3D folder holds."""
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; set data.root to the CO3D download")
    return sorted(file.parent.name for file in root.glob(f"*/{FRAME_ANNOTATIONS}"))


def require_category(root: Path, category: str) -> None:
    """InputError where the folder does not hold the category; says which ones it does."""
    known = list_categories(root)
    if category not in known:
        present = ", ".join(known) or f"none (no folder in it has a {FRAME_ANNOTATIONS})"
        raise InputError(f"{root}: has no category {category!r}; categories present: {present}")


def read_category(root: Path, category: str) -> list[FrameSequence]:
    """All sequences of a category, by name; frames by number, those without a camera left out.

    So are those whose entry cannot be read or contradicts another, or whose camera is degenerate,
    and the sequences say so; InputError where all are.
    """
    require_category(root, category)
    file = root / category / FRAME_ANNOTATIONS
    with _collector_paused():
        details = read_sequence_annotations(root / category / SEQUENCE_ANNOTATIONS)
        posed = _group_posed_frames(root, file)
        return [
            # Popped: its parts go as soon as the sequence is made.
            _sequence(root, category, name, posed.pop(name), details.get(name), file)
            for name in sorted(posed)
            if posed[name].parts or posed[name].left_out
        ]


@contextmanager
def _collector_paused() -> Iterator[None]:
    """Hold off the search for cycles: over millions of new objects it takes half the time."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@dataclass
class _Posed:
    """What one sequence has of frames with a camera."""

    parts: list[Co3dFrames] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    """Why each of the others is: their entry or camera makes no sense."""
    blackened: int = 0
    """Hidden targets of the challenge, which are left out as known and not as damage."""


def _group_posed_frames(root: Path, file: Path) -> dict[str, _Posed]:
    """The frames that have a camera; a sequence's entries need not stand together."""
    posed: dict[str | None, _Posed] = defaultdict(_Posed)
    entries, count = read_frame_annotations(file), 0
    while taken := _take(islice(entries, _ENTRIES_AT_A_TIME), posed, root, file):
        count += taken
    sound = sum(len(part) for sequence in posed.values() for part in sequence.parts)
    unusable = [reason for sequence in posed.values() for reason in sequence.left_out]
    blackened = sum(sequence.blackened for sequence in posed.values())
    without_camera = count - sound - len(unusable) - blackened
    if without_camera:
        log.warning("%s: %d frames have no camera and are left out", file, without_camera)
    if blackened:
        log.warning("%s: %d black frames, targets of the challenge, are left out", file, blackened)
    if not posed:
        raise InputError(f"{file}: no frame has a camera; choose another category")
    if not sound:
        which = f"none of the {count} frames of {file.parent.name} can be used"
        why = f"the first because of {unusable[0]}" if unusable else "all of them are black"
        raise InputError(f"{which}, {why}; choose another category")
    if unusable:
        log.warning("%d frames are left out, the first: %s", len(unusable), unusable[0])
    return {name: sequence for name, sequence in posed.items() if name is not None}


def _take(
    entries: Iterator[FrameAnnotation | BadEntry],
    posed: dict[str | None, _Posed],
    root: Path,
    file: Path,
) -> int:
    """Add the entries that have a camera to `posed`, as columns; returns how many there were.

    Those of which not even the sequence can be read are None's.
    """
    by_sequence: dict[str, list[FrameAnnotation]] = defaultdict(list)
    count = 0
    for annotation in entries:
        count += 1
        if isinstance(annotation, BadEntry):
            posed[annotation.sequence].left_out.append(annotation.reason)
            continue
        if annotation.viewpoint is None:
            continue
        if is_blackened(root, annotation):
            posed[annotation.sequence].blackened += 1
        else:
            by_sequence[annotation.sequence].append(annotation)
    for name, annotations in by_sequence.items():
        part, left_out = Co3dFrames.of(root, annotations, file)
        posed[name].parts.append(part)
        posed[name].left_out.extend(left_out)
    return count


def read_sequence(root: Path, category: str, name: str) -> FrameSequence:
    """One sequence of a category; InputError where none of its frames can be used."""
    sequences = {sequence.name: sequence for sequence in read_category(root, category)}
    if name not in sequences:
        raise InputError(
            f"{root / category}: has no sequence {name!r}; {did_you_mean(name, sequences)}"
        )
    sequence = sequences[name]
    if not sequence.frames:
        raise InputError(f"{name}: none of its frames can be used: {sequence.left_out[0]}")
    return sequence


def _sequence(
    root: Path,
    category: str,
    name: str,
    posed: _Posed,
    details: SequenceAnnotation | None,
    file: Path,
) -> FrameSequence:
    frames: Sequence[Frame] = ()
    left_out = list(posed.left_out)
    if posed.parts:
        joined = Co3dFrames.join(posed.parts)
        frames, contradictory = joined.without_duplicates(file)
        left_out += contradictory
        if doubled := len(joined) - len(frames):
            which = contradictory[0] if contradictory else "whose entries agree"
            log.warning("%s: %d entries of %s list an image again, %s", file, doubled, name, which)
    cloud = details.point_cloud_path if details else None
    return FrameSequence(
        category=category,
        name=name,
        frames=frames,
        left_out=tuple(left_out),
        viewpoint_quality=details.viewpoint_quality if details else None,
        point_cloud_quality=details.point_cloud_quality if details else None,
        point_cloud=PointFile(root, cloud) if cloud else None,
    )
