"""What a training needs at least, in memory and on disk, and what there is."""

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

from extrap_train.config import TrainerConfig
from extrap_train.device import trainer_device
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.errors import InputError

_BYTES = 4
"""Of a number: weights, moments and averages are kept in single precision."""
_CHECKPOINTS = 3
"""At a time on disk: two are kept while a third is written."""
_LIMITS = {"": ("", "memory.max"), "memory": ("memory", "memory.limit_in_bytes")}
"""Folder of control groups below `_CGROUPS` and the file with a group's limit, of both versions: by
the controllers that `/proc/self/cgroup` names, none in version 2.
"""
_CGROUPS = Path("/sys/fs/cgroup")
_PROC = Path("/proc")


@dataclass(frozen=True)
class Footprint:
    """Bytes that a training needs, activations and batches aside."""

    memory: int
    """Weights, gradients, both moments and the average, on the training device; frozen networks."""
    disk: int
    """Checkpoints and the saved model."""

    @classmethod
    def of(cls, model: ExtrapolationModel, options: TrainerConfig) -> "Footprint":
        """The footprint of training `model`."""
        trained = _BYTES * sum(x.numel() for x in model.parameters())
        whole = _BYTES * sum(
            x.numel() for network in model.parts().values() for x in network.parameters()
        )
        averages = 1 if options.ema_decay else 0
        memory = whole + (3 + averages) * trained
        return cls(memory, _CHECKPOINTS * (3 + averages) * trained + whole)


def require_room(footprint: Footprint, options: TrainerConfig, folder: Path) -> str:
    """What is needed against what there is, in a line; InputError where it cannot be enough.

    `folder` is the run's; the checkpoints that lie in it count as free.
    """
    device = trainer_device(options)
    memory = free_memory(device)
    place = next(path for path in (folder, *folder.resolve().parents) if path.exists())
    disk = shutil.disk_usage(place).free + sum(
        path.stat().st_size for path in folder.glob("checkpoints/*.ckpt")
    )
    said = (
        f"memory: at least {_gib(footprint.memory)} and activations, {_gib(memory)} available on "
        f"{device.type}; disk: {_gib(footprint.disk)}, {_gib(disk)} free"
    )
    if footprint.memory > memory:
        less = "trainer.ema_decay=0 (no averaged weights), " if options.ema_decay else ""
        raise InputError(f"{said}: give {less}a smaller model or a machine with more memory")
    if footprint.disk > disk:
        raise InputError(f"{said}: free space or choose another output=")
    return said


def free_memory(device: torch.device) -> int:
    """Bytes that this process may take on a device, with what it holds of the machine's already.

    A control group's limit counts, as a container or a SLURM job has one.
    """
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    if not _PROC.is_dir():  # not Linux, and nobody says how much of it is free
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    machine, own = (_sizes(_PROC / name) for name in ("meminfo", "self/status"))
    return min([machine["MemAvailable"] + own["VmRSS"], *_group_limits()])


def _group_limits() -> Iterator[int]:
    """Limits of the control groups of this process, each within the one before it.

    A container sees its own as the root, a SLURM job its own further down.
    """
    for line in _read(_PROC / "self/cgroup").splitlines():
        _, controllers, group = line.split(":", 2)
        if controllers in _LIMITS:
            below, name = _LIMITS[controllers]
            place = _CGROUPS / below / group.lstrip("/")
            limits = (_read(each / name) for each in (place, *place.parents))
            yield from (int(limit) for limit in limits if limit.isdigit())


def _read(file: Path) -> str:
    try:
        return file.read_text().strip()
    except OSError:
        return ""


def _sizes(file: Path) -> dict[str, int]:
    """What a file of Linux's says in kibibytes, in bytes."""
    lines = [line.split() for line in file.read_text().splitlines()]
    return {words[0].rstrip(":"): 1024 * int(words[1]) for words in lines if words[-1:] == ["kB"]}


def _gib(size: int) -> str:
    return f"{size / 2**30:.1f} GiB"
