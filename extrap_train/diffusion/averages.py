"""Power-function averages on the way through training, and a model made of them afterwards."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from extrap_train.config import TrainerConfig
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.power_average import Profile, decay_at, exponent_of, mixture
from extrap_train.diffusion.training import CategoryTraining
from extrap_train.errors import InputError
from extrap_train.store.atomic import write_atomic

TRACKED_WIDTHS = (0.05, 0.1)
"""Relative widths of the averages that are kept (Karras et al. 2024)."""
MOST_SNAPSHOTS = 16
"""On disk. The nine that are left of more give the profile of any width from 0.05 to 0.15 within
4 %, of 0.2 within 8 %, of 0.03 within 9 %.
"""


class PowerAverages(Callback):
    """Keeps an average of each tracked width, and snapshots of them in half precision: one an epoch
    of `every` steps, thinned out as they become many.

    The averages are part of a run's checkpoints, so that a resumed run's are the same.
    """

    def __init__(self, folder: Path, every: int) -> None:
        self.folder = folder
        self.every = every
        self.averages: dict[str, dict[str, Tensor]] = {}
        self._exponents = {str(width): exponent_of(width) for width in TRACKED_WIDTHS}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Begin with the weights as they are, which the first step replaces."""
        trained = _trained(pl_module)
        for width in TRACKED_WIDTHS:
            saved = self.averages.get(str(width), trained)
            self.averages[str(width)] = {
                name: saved[name].detach().to(x.device, copy=True) for name, x in trained.items()
            }

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: object,
        batch: object,
        batch_idx: int,
    ) -> None:
        """Take the step's weights in."""
        values = list(_trained(pl_module).values())
        for width, means in self.averages.items():
            taken = 1 - decay_at(trainer.global_step, self._exponents[width])
            torch._foreach_lerp_(list(means.values()), values, taken)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write a snapshot, whole or not at all, and drop those that are too many now."""
        if not trainer.is_global_zero:
            return
        tensors = {
            f"{width}/{name}": mean.half().cpu().contiguous()
            for width, means in self.averages.items()
            for name, mean in means.items()
        }
        write_atomic(self.folder / f"step-{trainer.global_step:08d}.safetensors", save(tensors))
        found = {_step_of(file): file for file in _snapshots(self.folder)}
        for step in found.keys() - set(thinned(list(found), self.every)):
            found[step].unlink()

    def state_dict(self) -> dict[str, Any]:
        """The averages in full precision."""
        return {"averages": self.averages}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a checkpoint's averages."""
        self.averages = state_dict["averages"]


def thinned(steps: Sequence[int], every: int) -> list[int]:
    """Those of the snapshots' steps that are kept, at most `MOST_SNAPSHOTS`: the newest, and the
    multiples of `every`, twice or four times … that.

    It follows from the newest step alone, whatever was killed and resumed on the way.
    """
    newest, period = max(steps), every
    while -(-newest // period) > MOST_SNAPSHOTS:
        period *= 2
    return sorted(step for step in steps if step % period == 0 or step == newest)


def snapshot_bytes(model: ExtrapolationModel, options: TrainerConfig) -> int:
    """What the snapshots take on disk at most, one that is not thinned out yet among them."""
    if not options.power_averages:
        return 0
    count = min(-(-options.steps // options.checkpoint_every), MOST_SNAPSHOTS + 1)
    weights = sum(x.numel() for x in model.parameters())
    return count * len(TRACKED_WIDTHS) * torch.float16.itemsize * weights


def _snapshots(folder: Path) -> list[Path]:
    return sorted(folder.glob("step-*.safetensors"))


def _step_of(snapshot: Path) -> int:
    return int(snapshot.stem.split("-")[1])


def _trained(module: LightningModule) -> dict[str, Tensor]:
    assert isinstance(module, CategoryTraining)
    return {name: x.detach() for name, x in module.model.named_parameters()}


def take_average(model: ExtrapolationModel, folder: Path, relative_width: float) -> int:
    """Give the model the weights' average of a width at the newest snapshot's step; returns it.

    Raises InputError where there are no snapshots, or where one cannot be read or is of another
    model.
    """
    weights, step = _averaged(folder, relative_width)
    own = dict(model.named_parameters())
    if {name: x.shape for name, x in weights.items()} != {name: x.shape for name, x in own.items()}:
        raise InputError(f"{folder}: is of another model than the run's")
    with torch.no_grad():
        for name, parameter in own.items():
            parameter.copy_(weights[name])
    return step


def _averaged(folder: Path, relative_width: float) -> tuple[dict[str, Tensor], int]:
    files = _snapshots(folder)
    if not files:
        raise InputError(
            f"{folder}: holds no snapshots of averages; train with trainer.power_averages=true"
        )
    steps = [_step_of(file) for file in files]
    widths = [(step, width) for step in steps for width in TRACKED_WIDTHS]
    profiles = [Profile(step, exponent_of(width)) for step, width in widths]
    shares = mixture(profiles, Profile(steps[-1], exponent_of(relative_width))).tolist()
    total: dict[str, Tensor] = {}
    for file, step in zip(files, steps, strict=True):
        for name, tensor in _read(file).items():
            width, _, parameter = name.partition("/")
            share = shares[widths.index((step, float(width)))]
            term = tensor.float() * share
            total[parameter] = total[parameter].add_(term) if parameter in total else term
    return total, steps[-1]


def _read(file: Path) -> dict[str, Tensor]:
    try:
        return load_file(file)
    except (OSError, SafetensorError) as error:
        raise InputError(
            f"{file}: cannot be read ({error}); delete it to do with the others"
        ) from None
