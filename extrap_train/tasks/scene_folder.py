"""The folder of a result about one scene, and what an interruption leaves there."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from extrap_train.config import TrainConfig
from extrap_train.errors import InputError
from extrap_train.runs import given_name

_MIB = 2**20


def result_folder(config: TrainConfig, label: str) -> Path:
    """Where a task's result about a scene lies: called like the scene, or as `run` says."""
    return Path(config.output) / config.task / (given_name(config) or label)


@contextmanager
def nothing_kept() -> Iterator[None]:
    """Say on Ctrl-C that the block, whose result appears at its end, leaves nothing."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            "nothing was changed; the same command starts from the beginning"
        ) from None


def require_space(folder: Path, needed: int) -> None:
    """InputError if the disk that a folder will lie on has less than `needed` bytes left."""
    place = next(path for path in (folder, *folder.resolve().parents) if path.exists())
    free = shutil.disk_usage(place).free
    if free < needed:
        raise InputError(
            f"{folder}: no space left on the device ({free / _MIB:.1f} MiB free, about "
            f"{needed / _MIB:.1f} MiB needed); free some or choose another output="
        )
