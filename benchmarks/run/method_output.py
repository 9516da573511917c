"""What comes out of a method's process: data, of which every entry is checked."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import safetensors
import safetensors.numpy
from pydantic import TypeAdapter, ValidationError

from benchmarks.run.cell_record import FAILED, MADE, OK, MethodOutput, one_line
from extrap_train.errors import InputError
from extrap_train.jobs import Died

_MAX_TRACEBACK_LINES = 200
_MAX_WORDS = 100
MAX_POINTS = 5_000_000
"""Of a method's surface: more take hours to score."""
_RECORD, _IMAGES, _POINTS = "record", "images", "points"
_KIND = TypeAdapter(MethodOutput)


@dataclass(frozen=True)
class CheckedOutput:
    """A method's output with what came along."""

    output: MethodOutput
    images: list[np.ndarray] = field(default_factory=list)
    """Pixels by target, `uint8` of `h w 3`."""
    points: np.ndarray | None = None


def parse_output(content: str | bytes) -> MethodOutput:
    """The output in JSON; InputError names the first entry that is wrong."""
    try:
        return _KIND.validate_json(content, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise InputError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def pack_output(output: MethodOutput, arrays: Mapping[str, np.ndarray] | None = None) -> bytes:
    """Bytes for `check_output`; written by the process that is not trusted."""
    record = np.frombuffer(_KIND.dump_json(_clean(output)), np.uint8)
    contents = {name: np.ascontiguousarray(array) for name, array in (arrays or {}).items()}
    return safetensors.numpy.save({**contents, _RECORD: record})


def check_output(result: bytes | Died, targets: int, side: int, name: str) -> CheckedOutput:
    """A method's result if it is sound and as it was asked for, else a failure with the reason."""
    if isinstance(result, Died):
        return CheckedOutput(MethodOutput(status=FAILED, reason=result.reason))
    try:
        return _checked(result, (targets, side, side, 3))
    except InputError as error:
        reason = one_line(f"method {name}: {error}")
        return CheckedOutput(MethodOutput(status=FAILED, reason=reason))


def _checked(result: bytes, wanted: tuple[int, ...]) -> CheckedOutput:
    try:
        arrays = safetensors.numpy.load(result)
        content = arrays.pop(_RECORD).tobytes()
    except (safetensors.SafetensorError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"returned no result ({type(error).__name__})") from None
    output = _clean(parse_output(content))
    if output.status == OK:
        raise InputError("claims to be scored already")
    if output.status != MADE:
        kept = MethodOutput(status=output.status, reason=output.reason, traceback=output.traceback)
        return CheckedOutput(kept)
    images, points = arrays.get(_IMAGES), arrays.get(_POINTS)
    if images is None or images.dtype != np.uint8:
        raise InputError("returned no images")
    if images.shape != wanted:
        shapes = [(s[0], s[3], *s[1:3]) if len(s) == 4 else s for s in (images.shape, wanted)]
        raise InputError(f"made images {shapes[0]}, asked were {shapes[1]}")
    if points is not None:
        if points.dtype != np.float32 or points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"points are {points.dtype} of {points.shape}, not floats of (m, 3)")
        if not np.isfinite(points).all() or len(points) > MAX_POINTS:
            raise InputError(f"points must be finite and at most {MAX_POINTS:,}")
    return CheckedOutput(output, [*images], points)


def _clean(output: MethodOutput) -> MethodOutput:
    """Every text printable and of a length for a table."""
    if len(output.given) + len(output.counts) > _MAX_WORDS:
        raise InputError(f"given and counts have more than {_MAX_WORDS} entries")
    return replace(
        output,
        reason=one_line(output.reason),
        traceback=_lines(output.traceback),
        given={one_line(key): one_line(value) for key, value in output.given.items()},
        counts={one_line(key): value for key, value in output.counts.items()},
    )


def _lines(text: str) -> str:
    lines = text.splitlines()[-_MAX_TRACEBACK_LINES:]
    return "\n".join(" " * (len(one) - len(one.lstrip())) + one_line(one) for one in lines)
