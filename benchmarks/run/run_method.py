"""A method at work, in a process of its own: it is given a scene's inputs, and its output is handed
over as bytes, of which every entry is checked (`check_output`).
"""

import json
import os
import random
import resource
import sys
import traceback
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
import torch
from pydantic import TypeAdapter, ValidationError
from torch import Tensor

from benchmarks.methods.base import Method, SceneInputs, Stopwatch, Synthesis, Unavailable
from benchmarks.protocol.prepared_scene import RecordedDepth, Scene
from benchmarks.run.cells import (
    FAILED,
    MADE,
    OK,
    UNAVAILABLE,
    CellJob,
    CheckedOutput,
    MethodOutput,
    failed_output,
    one_line,
)
from extrap_train.config import MethodConfig
from extrap_train.data.image_files import to_eight_bits
from extrap_train.errors import InputError
from extrap_train.factories import make_object
from extrap_train.jobs import Died
from extrap_train.metrics import require_unit_range

PER_IMAGE = "per image"
"""`MethodConfig.time` of the methods whose perform time is that of one image."""


def run_method(job: CellJob) -> bytes:
    """Run a method on what it may know of a scene; whatever it raises is its status and reason."""
    torch.set_num_threads(1)  # the same images, however many workers there are
    if job.device != "cuda":  # before anything asks for a GPU: from then on it is there
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
    try:
        inputs = Scene.open(job.scene).inputs()
        with Stopwatch() as watch:
            for seed in (random.seed, np.random.seed, torch.manual_seed):
                seed(inputs.seed)
            method = build_method(job.method)
            weight_paths(method, inputs.category)  # what fails there is no sound method's
            synthesis = method.synthesize(inputs)
        return _pack_synthesis(synthesis, inputs, job.method, watch.seconds, peak_memory_mib())
    except Unavailable as error:
        return _pack({"status": UNAVAILABLE, "reason": one_line(str(error))})
    except BaseException as error:  # SystemExit and KeyboardInterrupt are its own, too
        reason = one_line(f"{type(error).__name__}: {error}")
        trace = _shorten(traceback.format_exc())
        return _pack({"status": FAILED, "reason": reason, "traceback": trace})


def build_method(config: MethodConfig) -> Method:
    """The method with its options; raises InputError for what does not fit."""
    name, prefix = f"method {config.name}", f"options.{config.name}."
    method: Method = make_object(config.factory, config.options, name, Method, prefix)
    return method


def weight_paths(method: Method, category: str) -> list[Path]:
    """The files that a method names; TypeError where it returns anything else."""
    files: Any = method.weight_files(category)
    if not isinstance(files, (list, tuple)) or not all(isinstance(f, (str, Path)) for f in files):
        raise TypeError(f"weight_files() returns paths, not {type(files).__name__}")
    return [Path(file) for file in files]


def _pack_synthesis(
    synthesis: Synthesis,
    inputs: SceneInputs,
    method: MethodConfig,
    wall_seconds: float,
    peak_memory_mib: float | None,
) -> bytes:
    images, points = synthesis.images, synthesis.points
    _require_floats(images, f"method {method.name}: images")
    require_unit_range(images)
    arrays = {_IMAGES: to_eight_bits(images.permute(0, 2, 3, 1))}
    if points is not None:
        _require_floats(points, f"method {method.name}: points")
        arrays[_POINTS] = points.detach().cpu().float().numpy()
    assert isinstance(inputs.depth_source, RecordedDepth)
    sharing = len(inputs.targets.world_to_cam) if method.time == PER_IMAGE else 1
    values = {
        "status": MADE,
        "seconds": synthesis.seconds + inputs.depth_source.seconds / sharing,
        "wall_seconds": wall_seconds,
        "peak_memory_mib": peak_memory_mib,
        "given": {**synthesis.given, "device": device_used()},
        "counts": dict(synthesis.counts),
    }
    try:
        return _pack(values, arrays)
    except TypeError as error:
        reason = f"seconds, given and counts take plain numbers and texts ({error})"
        raise InputError(f"method {method.name}: {reason}") from None


def _pack(values: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None) -> bytes:
    """Bytes for `check_output`; written by the process that is not trusted."""
    record = np.frombuffer(json.dumps(values).encode(), np.uint8)
    contents = {name: np.ascontiguousarray(array) for name, array in (arrays or {}).items()}
    return safetensors.numpy.save({**contents, _RECORD: record})


def peak_memory_mib() -> float | None:
    """The most memory that this process has held, of the GPU where it used one; None where the
    system (no Linux) cannot say.

    Each method has a process of its own, which begins with what its server had imported.
    """
    if device_used() == "cuda":
        return torch.cuda.max_memory_allocated() / 2**20
    if sys.platform != "linux":
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def device_used() -> str:
    """Where this process's tensors were: a method that a GPU is lent to may run on the CPU."""
    used = torch.cuda.is_available() and torch.cuda.max_memory_allocated() > 0
    return "cuda" if used else "cpu"


def _require_floats(values: Any, what: str) -> None:
    if not (isinstance(values, Tensor) and values.is_floating_point()):
        kind = values.dtype if isinstance(values, Tensor) else type(values).__name__
        raise InputError(f"{what} must be a tensor of floats, not {kind}")


_MAX_TRACEBACK_LINES = 200
_MAX_WORDS = 100
MAX_POINTS = 5_000_000
"""Most points of a method's surface: more take hours to score."""
_RECORD, _IMAGES, _POINTS = "record", "images", "points"
_KIND = TypeAdapter(MethodOutput)


def check_output(result: bytes | Died, targets: int, side: int, name: str) -> CheckedOutput:
    """A method's result if it is sound and as it was asked for, else a failure with the reason."""
    if isinstance(result, Died):
        return failed_output(result.reason)
    try:
        return _checked(result, (targets, side, side, 3))
    except InputError as error:
        return failed_output(one_line(f"method {name}: {error}"))


def _checked(result: bytes, wanted: tuple[int, ...]) -> CheckedOutput:
    try:
        arrays = safetensors.numpy.load(result)
        content = arrays.pop(_RECORD).tobytes()
    except (safetensors.SafetensorError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"returned no result ({type(error).__name__})") from None
    output = _parse(content)
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


def _parse(content: bytes) -> MethodOutput:
    """The output in JSON, every text printable and of a length for a table; InputError names the
    first entry that is wrong.
    """
    try:
        output = _KIND.validate_json(content, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise InputError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    if len(output.given) + len(output.counts) > _MAX_WORDS:
        raise InputError(f"given and counts have more than {_MAX_WORDS} entries")
    return replace(
        output,
        reason=one_line(output.reason),
        traceback=_shorten(output.traceback),
        given={one_line(key): one_line(value) for key, value in output.given.items()},
        counts={one_line(key): value for key, value in output.counts.items()},
    )


def _shorten(text: str) -> str:
    lines = text.splitlines()[-_MAX_TRACEBACK_LINES:]
    return "\n".join(" " * (len(one) - len(one.lstrip())) + one_line(one) for one in lines)
