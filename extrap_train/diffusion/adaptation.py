"""Training a scene's adapter within a time budget, ended early by a held-out pair."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import peft
import torch
from lightning.fabric import Fabric
from torch import Tensor

from extrap_train.config import LoraConfig, SamplerConfig
from extrap_train.data.module import with_warp
from extrap_train.data.scene_pairs import ScenePairs
from extrap_train.diffusion.loss import diffusion_loss, prediction_errors
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.schedule import solver_of

_DRAWS = 8
"""Of noise, at every level at which the held-out pair is measured."""
_WARMUP = 20
"""Steps until the full learning rate."""
_AVERAGE_DECAY = 0.95


@dataclass(frozen=True)
class Adaptation:
    """How an adapter was trained."""

    losses: list[tuple[int, float]]
    """(step, error on the held-out pair); the first is the model's without the adapter."""
    best_step: int
    """The step whose weights were kept; 0 keeps the model as it was."""
    steps: int
    seconds: float
    ended: str
    """`held-out pair`, `time` or `steps`."""


def adapt(
    model: ExtrapolationModel,
    adapter: peft.PeftModel,
    pairs: ScenePairs,
    options: LoraConfig,
    sampler: SamplerConfig,
    *,
    seconds: float,
    seed: int,
    fabric: Fabric,
    on_step: Callable[[int, float], None] = lambda step, share: None,
    clock: Callable[[], float] = time.monotonic,
) -> Adaptation:
    """Train the adapter and leave its best weights upon the model.

    Candidates are moving averages: the base is one, and single steps away from it are noisier than
    what they learn. The best has the least error on the held-out pair, measured with fixed noise at
    the levels that the sampler steps through. `on_step` hears of every step and the share of the
    budget that is spent. Steps are a function of the seed; how many depends on the clock.
    """
    started = clock()
    trained = [weight for weight in model.parameters() if weight.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=options.learning_rate, weight_decay=0.0)
    measure = _HeldOut(model, pairs, sampler, fabric)
    losses = [(0, measure())]
    average = _weights(adapter)
    best, best_step = _weights(adapter), 0
    step, ended = 0, "steps"
    while step < options.steps:
        optimizer.param_groups[0]["lr"] = options.learning_rate * min(1.0, (step + 1) / _WARMUP)
        _train_step(model, pairs, options, optimizer, seed, step, fabric)
        step += 1
        newest = _weights(adapter)
        for name, value in average.items():
            value.lerp_(newest[name], 1 - min(_AVERAGE_DECAY, (1 + step) / (10 + step)))
        spent = (clock() - started) / seconds
        on_step(step, spent)
        if step % options.validate_every and spent < 1:
            continue
        peft.set_peft_model_state_dict(adapter, average)
        losses.append((step, measure()))
        if losses[-1][1] < min(loss for _, loss in losses[:-1]):
            best, best_step = _weights(adapter), step
        peft.set_peft_model_state_dict(adapter, newest)
        if spent >= 1:
            ended = "time"
            break
        if step - best_step >= options.patience * options.validate_every:
            ended = "held-out pair"
            break
    peft.set_peft_model_state_dict(adapter, best)
    return Adaptation(losses, best_step, step, clock() - started, ended)


def _train_step(
    model: ExtrapolationModel,
    pairs: ScenePairs,
    options: LoraConfig,
    optimizer: torch.optim.Optimizer,
    seed: int,
    step: int,
    fabric: Fabric,
) -> None:
    rng = np.random.default_rng((seed, step))
    batch = pairs.training_batch(options.batch_size, rng).to(fabric.device)
    batch = with_warp(batch, model.config.image_size)
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    with fabric.autocast():
        loss = diffusion_loss(model, batch, generator, 0.0)
    optimizer.zero_grad()
    fabric.backward(loss)
    optimizer.step()


class _HeldOut:
    """The error on the held-out pair."""

    def __init__(
        self, model: ExtrapolationModel, pairs: ScenePairs, sampler: SamplerConfig, fabric: Fabric
    ) -> None:
        levels = solver_of(model.schedule, sampler).timesteps
        self.model, self.fabric = model, fabric
        self.timestep = levels.repeat(_DRAWS).to(fabric.device)
        batch = pairs.held_out_batch(len(self.timestep)).to(fabric.device)
        self.batch = with_warp(batch, model.config.image_size)

    @torch.no_grad()
    def __call__(self) -> float:
        with self.fabric.autocast():
            conditioning = self.model.condition(self.batch)
            target = self.model.encode_target(self.batch.image, conditioning)
            generator = torch.Generator().manual_seed(0)
            noise = torch.randn(target.shape, generator=generator).to(target)
            errors = prediction_errors(self.model, target, noise, self.timestep, conditioning)
        return float(errors.mean())


def _weights(adapter: peft.PeftModel) -> dict[str, Tensor]:
    return {k: v.clone() for k, v in peft.get_peft_model_state_dict(adapter).items()}
