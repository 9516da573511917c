"""Several processes that train one model, each on its own device: the first opens the run, the
others join it.
"""

import atexit
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
import torch.distributed as dist
from lightning.pytorch.utilities import rank_zero_only

from extrap_train.errors import InputError
from extrap_train.store.records import read_record, write_record

T = TypeVar("T")

_LAUNCHES = ("SLURM_JOB_ID", "SLURM_STEP_ID", "SLURM_RESTART_COUNT")
"""What tells one launch of all processes from another under SLURM. Those that Lightning starts find
the word of the first, which starts them after it has given it; torchrun's meet before (`meet`).
"""
_WAIT_S = 300.0
_LOOK_EVERY_S = 0.1


@dataclass(frozen=True)
class Opening:
    """What the first process found when it opened the run, and all of them go by."""

    is_finished: bool
    checkpoint: str | None
    """Path of the checkpoint to resume from."""
    launch: dict[str, str] = field(default_factory=lambda: _launch())
    """What tells this launch from an earlier one."""


def is_first() -> bool:
    """Whether this process is the only one or the one that opens, saves and speaks for all.

    Known before the processes have met, from the launcher's variables, as Lightning reads them.
    """
    return cast(Any, rank_zero_only).rank == 0


def meet() -> None:
    """Let the processes of a torchrun meet: by its variables one launch looks like another.

    Lightning takes the group that it finds, and then leaves its end to us.
    """
    if "TORCHELASTIC_RUN_ID" in os.environ and not dist.is_initialized():
        dist.init_process_group()
        atexit.register(dist.destroy_process_group)


def announce(folder: Path, opening: Opening) -> None:
    """Tell the other processes of this launch that the run is open."""
    if dist.is_initialized():
        _broadcast(opening)
    else:
        write_record(_announcement(folder), opening)


def join(folder: Path, wait_s: float = _WAIT_S) -> Opening:
    """What the first process of this launch has found; waits until it has.

    Raises InputError where it has not within `wait_s`, or has ended instead.
    """
    unopened = f"{folder}: has not been opened by the first process of this launch"
    if dist.is_initialized():
        try:
            return cast(Opening, _broadcast(None))
        except RuntimeError:  # of a connection that was closed, or of a group that waited too long
            raise InputError(f"{unopened}; see what that one says") from None
    ends = time.monotonic() + wait_s
    while (opening := _read_announced(folder)) is None:
        if time.monotonic() >= ends:
            raise InputError(f"{unopened} in {wait_s:.0f} s; see what that one says")
        time.sleep(_LOOK_EVERY_S)
    return opening


def gather_values(value: T) -> list[T]:
    """Every process's value, in the order of their ranks; tensors must be on the CPU."""
    if not (dist.is_available() and dist.is_initialized()):
        return [value]
    values: list[Any] = [None] * dist.get_world_size()
    dist.all_gather_object(values, value)
    return values


def _broadcast(value: Opening | None) -> Opening | None:
    """The first process's value, in all of them."""
    values = [value]
    dist.broadcast_object_list(values, device=torch.device("cpu"))
    return values[0]


def _read_announced(folder: Path) -> Opening | None:
    file = _announcement(folder)
    if not file.exists():
        return None
    opening = read_record(file, Opening, "delete it and start the command again")
    return opening if opening.launch == _launch() else None


def _announcement(folder: Path) -> Path:
    return folder / ".opened.json"


def _launch() -> dict[str, str]:
    return {name: os.environ[name] for name in _LAUNCHES if name in os.environ}
