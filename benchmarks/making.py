"""Making a cell's images: a method is given a scene's inputs, and what it makes becomes files.

Only what this module imports decides images; a change in how they are scored leaves them alone.
"""

from dataclasses import dataclass
from typing import Any

import torch

from benchmarks.files import npy_bytes, png_bytes
from benchmarks.memory import PeakMemory
from benchmarks.methods.base import SceneInputs, Stopwatch, Synthesis
from benchmarks.methods.build import build_method
from benchmarks.recorded_depth import RecordedDepth
from benchmarks.scenes import Scene
from extrap_train.config import MethodConfig
from extrap_train.errors import InputError
from extrap_train.metrics import require_unit_range

PER_IMAGE = "per image"
"""`MethodConfig.time` of the methods whose perform time is that of one image."""
MEASURED = ("seconds", "wall_seconds", "peak_memory_mib", "given", "counts")
"""What a record keeps of the making, apart from its files."""


@dataclass(frozen=True)
class Made:
    """What a method has made of a scene, as it is kept."""

    measured: dict[str, Any]
    """The entries of `MEASURED`."""
    images: dict[str, bytes]
    """PNG files by name, in the order of the targets."""
    points: dict[str, bytes]
    """One file of the reconstructed surface, where the method has any."""


def make(method: MethodConfig, scene: Scene) -> Made:
    """Run a method on what it may know of a scene; InputError where it makes other images than it
    was asked for.
    """
    inputs = scene.inputs()
    with PeakMemory() as memory, Stopwatch() as watch:
        synthesis = _synthesize(method, inputs)
    points = synthesis.points
    return Made(
        measured={
            "seconds": synthesis.seconds + _depth_share(inputs, method),
            "wall_seconds": watch.seconds,
            "peak_memory_mib": memory.mib,
            "given": dict(synthesis.given),
            "counts": dict(synthesis.counts),
        },
        images={f"{i}.png": png_bytes(image) for i, image in enumerate(synthesis.images)},
        points={} if points is None else {"points.npy": npy_bytes(points)},
    )


def _synthesize(method: MethodConfig, inputs: SceneInputs) -> Synthesis:
    torch.manual_seed(inputs.seed)
    synthesis = build_method(method).synthesize(inputs)
    wanted = (len(inputs.targets.world_to_cam), 3, inputs.targets.height, inputs.targets.width)
    if tuple(synthesis.images.shape) != wanted:
        found = tuple(synthesis.images.shape)
        raise InputError(f"method {method.name}: made images {found}, asked were {wanted}")
    require_unit_range(synthesis.images)
    return synthesis


def _depth_share(inputs: SceneInputs, method: MethodConfig) -> float:
    """What finding the inputs' depth took, for the methods that asked for it."""
    assert isinstance(inputs.depth_source, RecordedDepth)
    count = len(inputs.targets.world_to_cam) if method.time == PER_IMAGE else 1
    return inputs.depth_source.seconds / count
