"""What comes out of a method's process, and how it is let in: as data, every entry checked."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import safetensors
import safetensors.numpy
from pydantic import TypeAdapter, ValidationError

from benchmarks.records import FAILED, MADE, Measured
from benchmarks.words import one_line
from extrap_train.errors import InputError
from extrap_train.jobs import Died

_MAX_TRACEBACK_LINES = 200
_MAX_WORDS = 100
MAX_POINTS = 5_000_000
"""Of a method's surface: more take hours to score."""
_RECORD, _IMAGES, _POINTS = "record", "images", "points"


@dataclass(frozen=True)
class Handed:
    """What a method's process says of its work."""

    status: Literal["made", "failed", "unavailable"]
    reason: str = ""
    traceback: str = ""
    measured: Measured | None = None
    """Where there are images."""


@dataclass(frozen=True)
class LetIn:
    """The same, with what came along."""

    handed: Handed
    images: list[np.ndarray] = field(default_factory=list)
    """Pixels by target, `uint8` of `h w 3`."""
    points: np.ndarray | None = None


_KIND = TypeAdapter(Handed)


def measured_of(values: Mapping[str, Any], name: str) -> Measured:
    """Checked values of `Measured`; raises InputError which names the first that is wrong."""
    try:
        return TypeAdapter(Measured).validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        raise InputError(f"method {name}: {_first(error)}") from None
    except TypeError as error:
        raise InputError(
            f"method {name}: seconds, given and counts take plain numbers and texts ({error})"
        ) from None


def packed(handed: Handed, arrays: Mapping[str, np.ndarray] | None = None) -> bytes:
    """Bytes for `let_in`; written by the process that is not trusted."""
    clean = replace(handed, reason=one_line(handed.reason), traceback=_lines(handed.traceback))
    record = np.frombuffer(_KIND.dump_json(clean), np.uint8)
    contents = {name: np.ascontiguousarray(array) for name, array in (arrays or {}).items()}
    return safetensors.numpy.save({**contents, _RECORD: record})


def let_in(result: bytes | Died, targets: int, side: int, name: str) -> LetIn:
    """A method's result if it is sound and as it was asked for, else a failure with the reason."""
    if isinstance(result, Died):
        return LetIn(Handed(FAILED, result.reason))
    try:
        return _checked(result, (targets, side, side, 3))
    except InputError as error:
        return LetIn(Handed(FAILED, one_line(f"method {name}: {error}")))


def _checked(result: bytes, wanted: tuple[int, ...]) -> LetIn:
    try:
        arrays = safetensors.numpy.load(result)
        handed = _KIND.validate_json(arrays.pop(_RECORD).tobytes(), strict=True)
    except ValidationError as error:
        raise InputError(_first(error)) from None
    except (safetensors.SafetensorError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"handed out no result ({type(error).__name__})") from None
    if handed.status != MADE:
        return LetIn(replace(_cleaned(handed), measured=None))
    images, points = arrays.get(_IMAGES), arrays.get(_POINTS)
    if handed.measured is None or images is None or images.dtype != np.uint8:
        raise InputError("handed out no images")
    if images.shape != wanted:
        shapes = [(s[0], s[3], *s[1:3]) if len(s) == 4 else s for s in (images.shape, wanted)]
        raise InputError(f"made images {shapes[0]}, asked were {shapes[1]}")
    if points is not None:
        if points.dtype != np.float32 or points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"points are {points.dtype} of {points.shape}, not floats of (m, 3)")
        if not np.isfinite(points).all() or len(points) > MAX_POINTS:
            raise InputError(f"points must be finite and at most {MAX_POINTS:,}")
    return LetIn(_cleaned(handed), [*images], points)


def _cleaned(handed: Handed) -> Handed:
    """Every text printable and of a length for a table."""
    made = handed.measured
    if made is not None:
        if len(made.given) + len(made.counts) > _MAX_WORDS:
            raise InputError(f"given and counts have more than {_MAX_WORDS} entries")
        given = {one_line(key): one_line(value) for key, value in made.given.items()}
        counts = {one_line(key): value for key, value in made.counts.items()}
        made = replace(made, given=given, counts=counts)
    lines = _lines(handed.traceback)
    return replace(handed, reason=one_line(handed.reason), traceback=lines, measured=made)


def _lines(text: str) -> str:
    lines = text.splitlines()[-_MAX_TRACEBACK_LINES:]
    return "\n".join(" " * (len(one) - len(one.lstrip())) + one_line(one) for one in lines)


def _first(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
