"""What comes out of a method's process: data, of which every entry is checked."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import safetensors
import safetensors.numpy
from pydantic import TypeAdapter, ValidationError

from benchmarks.run.cell_record import FAILED, MADE, Measured, one_line
from extrap_train.errors import InputError
from extrap_train.jobs import Died

_MAX_TRACEBACK_LINES = 200
_MAX_WORDS = 100
MAX_POINTS = 5_000_000
"""Of a method's surface: more take hours to score."""
_RECORD, _IMAGES, _POINTS = "record", "images", "points"


@dataclass(frozen=True)
class MethodOutput:
    """What a method's process says of its work."""

    status: Literal["made", "failed", "unavailable"]
    reason: str = ""
    traceback: str = ""
    measured: Measured | None = None
    """Where there are images."""


@dataclass(frozen=True)
class CheckedOutput:
    """The same, with what came along."""

    output: MethodOutput
    images: list[np.ndarray] = field(default_factory=list)
    """Pixels by target, `uint8` of `h w 3`."""
    points: np.ndarray | None = None


_KIND = TypeAdapter(MethodOutput)


def check_measured(values: Mapping[str, Any], name: str) -> Measured:
    """Checked values of `Measured`; raises InputError which names the first that is wrong."""
    try:
        return TypeAdapter(Measured).validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        raise InputError(f"method {name}: {_first(error)}") from None
    except TypeError as error:
        raise InputError(
            f"method {name}: seconds, given and counts take plain numbers and texts ({error})"
        ) from None


def pack_output(output: MethodOutput, arrays: Mapping[str, np.ndarray] | None = None) -> bytes:
    """Bytes for `check_output`; written by the process that is not trusted."""
    clean = replace(output, reason=one_line(output.reason), traceback=_lines(output.traceback))
    record = np.frombuffer(_KIND.dump_json(clean), np.uint8)
    contents = {name: np.ascontiguousarray(array) for name, array in (arrays or {}).items()}
    return safetensors.numpy.save({**contents, _RECORD: record})


def check_output(result: bytes | Died, targets: int, side: int, name: str) -> CheckedOutput:
    """A method's result if it is sound and as it was asked for, else a failure with the reason."""
    if isinstance(result, Died):
        return CheckedOutput(MethodOutput(FAILED, result.reason))
    try:
        return _checked(result, (targets, side, side, 3))
    except InputError as error:
        return CheckedOutput(MethodOutput(FAILED, one_line(f"method {name}: {error}")))


def _checked(result: bytes, wanted: tuple[int, ...]) -> CheckedOutput:
    try:
        arrays = safetensors.numpy.load(result)
        output = _KIND.validate_json(arrays.pop(_RECORD).tobytes(), strict=True)
    except ValidationError as error:
        raise InputError(_first(error)) from None
    except (safetensors.SafetensorError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"returned no result ({type(error).__name__})") from None
    if output.status != MADE:
        return CheckedOutput(replace(_clean(output), measured=None))
    images, points = arrays.get(_IMAGES), arrays.get(_POINTS)
    if output.measured is None or images is None or images.dtype != np.uint8:
        raise InputError("returned no images")
    if images.shape != wanted:
        shapes = [(s[0], s[3], *s[1:3]) if len(s) == 4 else s for s in (images.shape, wanted)]
        raise InputError(f"made images {shapes[0]}, asked were {shapes[1]}")
    if points is not None:
        if points.dtype != np.float32 or points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"points are {points.dtype} of {points.shape}, not floats of (m, 3)")
        if not np.isfinite(points).all() or len(points) > MAX_POINTS:
            raise InputError(f"points must be finite and at most {MAX_POINTS:,}")
    return CheckedOutput(_clean(output), [*images], points)


def _clean(output: MethodOutput) -> MethodOutput:
    """Every text printable and of a length for a table."""
    measured = output.measured
    if measured is not None:
        if len(measured.given) + len(measured.counts) > _MAX_WORDS:
            raise InputError(f"given and counts have more than {_MAX_WORDS} entries")
        given = {one_line(key): one_line(value) for key, value in measured.given.items()}
        counts = {one_line(key): value for key, value in measured.counts.items()}
        measured = replace(measured, given=given, counts=counts)
    lines = _lines(output.traceback)
    return replace(output, reason=one_line(output.reason), traceback=lines, measured=measured)


def _lines(text: str) -> str:
    lines = text.splitlines()[-_MAX_TRACEBACK_LINES:]
    return "\n".join(" " * (len(one) - len(one.lstrip())) + one_line(one) for one in lines)


def _first(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
