"""A method at work, in a process of its own: it is given a scene's inputs, and what it makes is
handed out as bytes (`benchmarks.door`).
"""

import os
import random
import traceback
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.cell_job import CellJob
from benchmarks.door import Handed, measured_of, packed
from benchmarks.memory import PeakMemory
from benchmarks.methods.base import SceneInputs, Stopwatch, Synthesis, Unavailable
from benchmarks.methods.build import build_method
from benchmarks.recorded_depth import RecordedDepth
from benchmarks.records import FAILED, MADE, UNAVAILABLE
from benchmarks.scenes import Scene
from extrap_train.config import MethodConfig
from extrap_train.data.images import to_eight_bits
from extrap_train.errors import InputError
from extrap_train.metrics import require_unit_range

PER_IMAGE = "per image"
"""`MethodConfig.time` of the methods whose perform time is that of one image."""


def make(job: CellJob) -> bytes:
    """Run a method on what it may know of a scene; whatever it raises is its status and reason."""
    torch.set_num_threads(1)  # the same images, however many workers there are
    if job.device != "cuda":  # before anything asks for a GPU: from then on it is there
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
    try:
        inputs = Scene.open(job.scene).inputs()
        with PeakMemory() as memory, Stopwatch() as watch:
            synthesis = _synthesize(job.method, inputs)
        return _handed(synthesis, inputs, job.method, watch.seconds, memory.mib)
    except Unavailable as error:
        return packed(Handed(UNAVAILABLE, str(error)))
    except BaseException as error:  # SystemExit and KeyboardInterrupt are its own, too
        reason = f"{type(error).__name__}: {error}"
        return packed(Handed(FAILED, reason, traceback.format_exc()))


def _synthesize(method: MethodConfig, inputs: SceneInputs) -> Synthesis:
    for seed in (random.seed, np.random.seed, torch.manual_seed):
        seed(inputs.seed)
    return build_method(method).synthesize(inputs)


def _handed(
    synthesis: Synthesis,
    inputs: SceneInputs,
    method: MethodConfig,
    wall_seconds: float,
    peak_memory_mib: float | None,
) -> bytes:
    images, points = synthesis.images, synthesis.points
    _require_floats(images, f"method {method.name}: images")
    require_unit_range(images)
    arrays = {"images": to_eight_bits(images.permute(0, 2, 3, 1))}
    if points is not None:
        _require_floats(points, f"method {method.name}: points")
        arrays["points"] = points.detach().cpu().float().numpy()
    values = {
        "seconds": synthesis.seconds + _depth_share(inputs, method),
        "wall_seconds": wall_seconds,
        "peak_memory_mib": peak_memory_mib,
        "given": dict(synthesis.given),
        "counts": dict(synthesis.counts),
    }
    return packed(Handed(MADE, measured=measured_of(values, method.name)), arrays)


def _require_floats(values: Any, what: str) -> None:
    if not (isinstance(values, Tensor) and values.is_floating_point()):
        kind = values.dtype if isinstance(values, Tensor) else type(values).__name__
        raise InputError(f"{what} must be a tensor of floats, not {kind}")


def _depth_share(inputs: SceneInputs, method: MethodConfig) -> float:
    """What finding the inputs' depth took, for the methods that asked for it."""
    assert isinstance(inputs.depth_source, RecordedDepth)
    count = len(inputs.targets.world_to_cam) if method.time == PER_IMAGE else 1
    return inputs.depth_source.seconds / count
