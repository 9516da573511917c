"""What a result about one scene is made from: options, and SHA-256 of the content of every input.

Two results of the same manifest are the same result, wherever their files lie.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from extrap_train.config import SyntheticConfig, TrainConfig, dotted
from extrap_train.data.scene import SYNTHETIC_SCHEME, scene_address
from extrap_train.data.sequences import Frame
from extrap_train.depth.sources import weight_files
from extrap_train.store.digests import file_digest
from extrap_train.store.manifest import Manifest
from extrap_train.tasks.scene_inputs import required_scene


def frame_digest(frame: Frame) -> str:
    """SHA-256 of a frame's camera, of how it is read, and of its photograph, mask and depth.

    A frame without files is rendered: that follows from the options and its name.
    """
    camera, rendered = frame.camera, [] if frame.files else [frame.name]
    about = [camera.height, camera.width, frame.reading, *rendered]
    digest = hashlib.sha256(json.dumps(about).encode())
    for tensor in (camera.world_to_cam, camera.intrinsics):
        digest.update(tensor.numpy(force=True).tobytes())
    for file in frame.files:
        digest.update((file_digest(file) if file.exists() else "missing").encode())
    return digest.hexdigest()


def photograph_digests(frames: Iterable[Frame]) -> dict[str, str]:
    """The frames' digests by their names."""
    return {frame.name: frame_digest(frame) for frame in frames}


def scene_manifest(
    config: TrainConfig,
    frames: Iterable[Frame],
    weights: Mapping[str, str],
    options: Mapping[str, Any],
) -> Manifest:
    """What a task's result about a scene is made from.

    `frames` are those that it reads, `weights` digests of what paints it, `options` the task's own.
    """
    scene = required_scene(config)
    made = isinstance(config.data, SyntheticConfig) and scene.startswith(SYNTHETIC_SCHEME)
    of_capture = ("frames", "image_size", "seed") if made else ()
    common = {
        "scene": scene_address(scene),
        "data": {name: getattr(config.data, name) for name in of_capture},
        "inputs": config.inputs,
        "input_frames": config.input_frames,
        "depth": asdict(config.depth),
        "sampler": asdict(config.sampler),
        "trainer.precision": config.trainer.precision,
        "seed": config.seed,
    }
    depth_files = [path for path in weight_files(config.depth) if path.is_file()]
    return Manifest.of(
        dotted(common) | dict(options),
        {
            **weights,
            **{f"weights of depth ({path.name})": file_digest(path) for path in depth_files},
            **{f"photograph {name}": d for name, d in photograph_digests(frames).items()},
        },
    )
