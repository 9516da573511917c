"""CO3D's annotations (v1 and v2) as typed records, and its set lists, their JSON checked."""

import logging
import math
import posixpath
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from extrap_train.data.depth_files import DepthFile
from extrap_train.data.image_files import MAX_PIXELS
from extrap_train.data.json_files import read_json, read_json_list, require_dict
from extrap_train.data.paths import check_relative
from extrap_train.errors import InputError
from extrap_train.geometry.foreign_cameras import NDC_FORMATS

T = TypeVar("T")

log = logging.getLogger(__name__)

VIEWPOINT = {"R": (3, 3), "T": (3,), "focal_length": (2,), "principal_point": (2,)}
"""The keys of a viewpoint and their shapes, in the order in which their numbers are kept."""
_REMEDY = "correct it, or is this no CO3D annotation file?"
_CHALLENGE_TARGET = "_unseen"
"""What `meta.frame_type` then ends in."""


@dataclass(frozen=True, slots=True)
class FrameAnnotation:
    """One frame; paths are relative to the data set's root."""

    sequence: str
    number: int
    image_path: str
    size: tuple[int, int]
    """(height, width) in pixels."""
    depth: DepthFile | None
    mask_path: str | None
    viewpoint: tuple[float, ...] | None
    """The numbers of `R`, `T`, `focal_length` and `principal_point`; they may make no sense."""
    intrinsics_format: str
    is_challenge_target: bool
    """Whether it is a target of CO3D's challenge, whose picture may have been blackened."""


@dataclass(frozen=True, slots=True)
class BadEntry:
    """An entry that cannot be read, and why."""

    sequence: str | None
    """The name of its sequence, if that much can be read."""
    reason: str


@dataclass(frozen=True, slots=True)
class SequenceAnnotation:
    """What is known of a whole sequence."""

    name: str
    viewpoint_quality: float | None
    point_cloud_path: str | None
    point_cloud_quality: float | None


def read_frame_annotations(file: Path) -> Iterator[FrameAnnotation | BadEntry]:
    """Every entry of a `frame_annotations.jgz`, in the file's order, one at a time."""
    return _parse_entries(file, _frame)


def read_sequence_annotations(file: Path) -> dict[str, SequenceAnnotation]:
    """The entries of a `sequence_annotations.jgz` by their sequence's name.

    Warns of entries that cannot be read; InputError where that is so of all.
    """
    found, bad = {}, []
    for entry in _parse_entries(file, _sequence):
        if isinstance(entry, BadEntry):
            bad.append(entry.reason)
        else:
            found[entry.name] = entry
    if not found:
        raise InputError(bad[0])
    if bad:
        log.warning("%d sequences have no description, the first: %s", len(bad), bad[0])
    return found


def read_sequence_split(
    root: Path, category: str, name: str
) -> tuple[frozenset[str], frozenset[str]]:
    """The sequences that a set list, e.g. `fewview_dev`, has for training, and those for testing.

    Raises InputError where it holds no sequence out: the many-view lists of the second release
    divide the frames of one.
    """
    file = root / category / "set_lists" / f"set_lists_{check_relative(name, root)}.json"
    if not file.is_file():
        known = sorted(f.stem.removeprefix("set_lists_") for f in file.parent.glob("set_lists_*"))
        raise InputError(f"{file}: no such set list; known: {', '.join(known) or 'none'}")
    content = require_dict(read_json(file), "an object with a list per subset", file)
    try:
        train, test = (
            frozenset(str(sequence) for sequence, _number, _path in content.get(subset, ()))
            for subset in ("train", "test")
        )
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{file}: entries must be [sequence, frame number, path] ({error}); check the file"
        ) from None
    advice = (
        "give data.set_list one that divides sequences, as fewview_dev, or leave it out: then "
        "data.test_sequences of them are held out, or frames of a lone one"
    )
    if shared := sorted(train & test):
        raise InputError(
            f"{file}: divides the frames of a sequence ({shared[0]}), not the sequences; {advice}"
        )
    if not train or not test:
        missing = "test" if train else "train"
        raise InputError(f"{file}: its list {missing!r} is empty; {advice}")
    return train, test


def _parse_entries(file: Path, parse: Callable[[Any, Path], T]) -> Iterator[T | BadEntry]:
    for index, entry in enumerate(read_json_list(file, "annotations")):
        try:
            parsed: T | BadEntry = parse(entry, file)
        except KeyError as error:
            parsed = _bad_entry(entry, f"{file}: entry {index} has no {error}; {_REMEDY}")
        except InputError as error:
            parsed = _bad_entry(entry, str(error))
        except (TypeError, ValueError, AttributeError, OverflowError) as error:
            why = f"{file}: entry {index} is malformed ({error}); {_REMEDY}"
            parsed = _bad_entry(entry, why)
        yield parsed


def _bad_entry(entry: Any, reason: str) -> BadEntry:
    try:
        return BadEntry(_require_type(entry["sequence_name"], str, "sequence_name"), reason)
    except (TypeError, ValueError, KeyError):
        return BadEntry(None, reason)


def _frame(entry: Any, file: Path) -> FrameAnnotation:
    image, viewpoint = entry["image"], entry.get("viewpoint")
    height, width = (_require_type(side, int, "image size") for side in image["size"])
    if not (0 < height <= MAX_PIXELS and 0 < width <= MAX_PIXELS):
        raise ValueError(f"image size {height} x {width}")
    # CO3D's first release has no format: it knew only this one.
    ndc = (viewpoint or {}).get("intrinsics_format", "ndc_norm_image_bounds")
    if ndc not in NDC_FORMATS:
        raise ValueError(f"intrinsics_format {ndc!r} is none of {', '.join(NDC_FORMATS)}")
    number = _require_type(entry["frame_number"], int, "frame_number")
    if abs(number) >= 2**63:
        raise ValueError(f"frame_number {number}")
    return FrameAnnotation(
        sequence=_require_type(entry["sequence_name"], str, "sequence_name"),
        number=number,
        image_path=_path(image["path"], file),
        size=(height, width),
        depth=_depth(entry.get("depth"), file),
        mask_path=_optional_path(entry.get("mask"), "path", file),
        viewpoint=_viewpoint(viewpoint) if viewpoint else None,
        intrinsics_format=ndc,
        is_challenge_target=_is_challenge_target(entry.get("meta")),
    )


def _viewpoint(viewpoint: dict[str, Any]) -> tuple[float, ...]:
    numbers: list[float] = []
    for key, shape in VIEWPOINT.items():
        value: Any = viewpoint.get(key)
        rows: Any = value if len(shape) == 2 else [value]
        try:
            found = [[_number(number) for number in row] for row in rows]
        except (TypeError, ValueError, OverflowError):
            found = []
        if [len(row) for row in found] != [shape[-1]] * math.prod(shape[:-1]):
            expected = " x ".join(map(str, shape))
            raise ValueError(f"the viewpoint has no {key} of {expected} numbers")
        numbers.extend(number for row in found for number in row)
    return tuple(numbers)


def _number(value: Any) -> float:
    """Truth values are not numbers: NaN, so that the entry is found degenerate."""
    return math.nan if isinstance(value, bool) else float(value)


def _is_challenge_target(meta: Any) -> bool:
    kind = meta.get("frame_type") if isinstance(meta, dict) else None
    return isinstance(kind, str) and kind.endswith(_CHALLENGE_TARGET)


def _depth(entry: Any, file: Path) -> DepthFile | None:
    if not entry or not entry.get("path"):
        return None
    return DepthFile(
        path=_path(entry["path"], file),
        scale=_number(entry["scale_adjustment"]),
        mask_path=_optional_path(entry, "mask_path", file),
        is_half_float=True,
    )


def _sequence(entry: Any, file: Path) -> SequenceAnnotation:
    cloud = entry.get("point_cloud")
    return SequenceAnnotation(
        name=_require_type(entry["sequence_name"], str, "sequence_name"),
        viewpoint_quality=_optional_float(entry.get("viewpoint_quality_score")),
        point_cloud_path=_optional_path(cloud, "path", file),
        point_cloud_quality=_optional_float(cloud.get("quality_score")) if cloud else None,
    )


def _path(value: Any, file: Path) -> str:
    """The same file has the same path, however it is spelt."""
    return posixpath.normpath(check_relative(_require_type(value, str, "path"), file))


def _optional_path(entry: Any, key: str, file: Path) -> str | None:
    value = entry.get(key) if entry else None
    return _path(value, file) if value else None


def _optional_float(value: Any) -> float | None:
    return None if value is None else float(value)


def _require_type(value: Any, kind: type, what: str) -> Any:
    if not isinstance(value, kind):
        raise TypeError(f"{what} is {value!r}, expected {kind.__name__}")
    if isinstance(value, str) and any("\ud800" <= letter <= "\udfff" for letter in value):
        raise ValueError(f"{what} {value!a} is not Unicode")  # tables and hashes cannot take it
    return value
