"""The folder of a result about one scene: what it was made with, and who may write there now."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from extrap_train.config import SyntheticConfig, TrainConfig, dotted
from extrap_train.data.scene import SYNTHETIC_SCHEME, scene_address
from extrap_train.errors import InputError
from extrap_train.runs import given_name
from extrap_train.store.atomic import atomic_folder, file_lock, remove_leftovers, write_atomic
from extrap_train.tasks.scene_inputs import named_weights, required_scene

MADE_WITH = "made_with.json"
"""The options that a result was made with, in its folder."""


def result_folder(config: TrainConfig, label: str) -> Path:
    """Where a task's result about a scene lies: called like the scene, or as `run` says."""
    return Path(config.output) / config.task / (given_name(config) or label)


def scene_options(config: TrainConfig) -> dict[str, Any]:
    """The options, by dotted key, that every picture of a scene follows from."""
    scene = required_scene(config)
    made = isinstance(config.data, SyntheticConfig) and scene.startswith(SYNTHETIC_SCHEME)
    options = {
        "scene": scene_address(scene),
        "data": {name: getattr(config.data, name) for name in ("frames", "image_size", "seed")}
        if made
        else {},
        "inputs": config.inputs,
        "input_frames": config.input_frames,
        "depth": asdict(config.depth),
        "weights": named_weights(config),
        "adapter": config.adapter and str(Path(config.adapter).resolve()),
        "sampler": asdict(config.sampler),
        "trainer.precision": config.trainer.precision,
        "seed": config.seed,
    }
    return dotted(options)


@contextmanager
def claimed(folder: Path, options: dict[str, Any], *, resume: bool) -> Iterator[None]:
    """The folder of a result, for this process alone as long as the block lasts.

    Raises InputError where another process has it, and with `resume` where what lies there was made
    with other options. Interrupted, the block leaves what was there before.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    taken = f"{folder}: another process is making this; wait for it or give run=NAME"
    try:
        with file_lock(folder.with_name(f".{folder.name}.lock"), taken):
            if resume and folder.exists():
                require_same(folder / MADE_WITH, options, "replace it")
            remove_leftovers(folder.parent)
            yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            "nothing was changed; the same command starts from the beginning"
        ) from None


@contextmanager
def whole_result(folder: Path, options: dict[str, Any]) -> Iterator[Path]:
    """A folder to write a result into, which takes the place of the older one at the end."""
    with atomic_folder(folder, lambda _: False) as made:
        yield made
        write_atomic(made / MADE_WITH, (json.dumps(options, indent=1) + "\n").encode())


def require_same(record: Path, options: dict[str, Any], otherwise: str) -> None:
    """InputError where `record` is of other options, or unreadable; says what else to do.

    `otherwise` is what `resume=false` would.
    """
    remedy = f"choose run=NAME for another folder, or resume=false to {otherwise}"
    try:
        before = json.loads(record.read_text())
        changed = [
            f"{key} (was {before.get(key)}, now {value})"
            for key, value in json.loads(json.dumps(options)).items()
            if before.get(key) != value
        ]
    except (OSError, ValueError, AttributeError):
        raise InputError(
            f"{record.parent}: there is no {record.name} that says what it was made with; {remedy}"
        ) from None
    if changed:
        raise InputError(
            f"{record.parent}: was made with other options: {', '.join(changed)}; {remedy}"
        )
