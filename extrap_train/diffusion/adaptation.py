"""Training a scene's adapter within a time budget, stopped early by held-out pairs."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import peft
import torch
from jaxtyping import Float, Int
from lightning.fabric import Fabric
from torch import Tensor

from extrap_train.config import LoraConfig, SamplerConfig
from extrap_train.data.scene_pairs import AdaptationPairs
from extrap_train.diffusion.averaging import move_average
from extrap_train.diffusion.conditioning import Conditioning
from extrap_train.diffusion.loss import Anchor, Unchanged, diffusion_loss, prediction_errors
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.sampler import sampling_timesteps
from extrap_train.diffusion.step_noise import StepNoise
from extrap_train.errors import InputError
from extrap_train.geometry.warp import compute_warp
from extrap_train.views import PairBatch, combine

_LEVELS = 4
"""Most noise levels at which held-out pairs are measured; a long schedule is taken in strides."""
_DRAWS = 8
"""Draws of noise at every level, shared among the held-out pairs."""
_MEASURING_SHARE = 0.1
"""Largest share of the time budget for measuring the held-out pairs once."""
_WARMUP = 20
"""Steps until the full learning rate."""
_AVERAGE_DECAY = 0.98
_CONDITION_DROPOUT = 0.05
"""Where sampling is guided: the adapter changes the null condition's prediction, too."""


@dataclass(frozen=True)
class Adaptation:
    """How an adapter was trained."""

    held_out_errors: list[tuple[int, float]]
    """(step, error on the held-out pairs); the first is the model's without the adapter."""
    best_step: int
    """The step whose weights were kept; 0 keeps the model as it was."""
    steps: int
    seconds: float
    ended: str
    """`held-out pair`, `time` or `steps`."""


def adapt(
    model: ExtrapolationModel,
    adapter: peft.PeftModel,
    pairs: AdaptationPairs,
    options: LoraConfig,
    sampler: SamplerConfig,
    *,
    seconds: float,
    seed: int,
    fabric: Fabric,
    on_step: Callable[[int, float], None] = lambda step, share: None,
    clock: Callable[[], float] = time.monotonic,
) -> Adaptation:
    """Train the adapter and leave the model with its best weights.

    With virtual references, pixels that the warp reaches are trained on the photograph; in holes
    the model is trained to keep its original prediction: few photographs show what surfaces look
    like here, but not what lies in other directions. The inputs' own pairs are trained on whole
    photographs, as in the paper.

    Candidates for the best weights are moving averages over the steps, because single steps are
    noisier than the progress between them; the base's own weights are the first candidate. The best
    has the least error on the held-out pairs, measured with fixed noise at levels that the sampler
    steps through: fewer of them where measuring all would take more than a tenth of the budget.
    `on_step` hears of step 0, the base measured, and of every step, with the share of the budget
    that is spent. Steps are a function of the seed; how many depends on the clock.
    """
    started = clock()

    def spent() -> float:
        return (clock() - started) / seconds

    trained = [weight for weight in model.parameters() if weight.requires_grad]
    rate = options.learning_rate or model.config.learning_rate
    # Set up by Fabric: with fp16 its steps undo the loss's scale.
    optimizer: Any = fabric.setup_optimizers(torch.optim.AdamW(trained, lr=rate, weight_decay=0.0))
    anchored = adapter.disable_adapter if options.virtual_references else None
    measure = _HeldOut(model, pairs.held_out_batch(), options.batch_size, sampler, fabric, anchored)
    measure.fit_into(_MEASURING_SHARE * seconds, clock)
    dropout = _CONDITION_DROPOUT if sampler.guidance != 1 else 0.0
    errors = [(0, measure())]
    if not math.isfinite(errors[0][1]):
        raise InputError(
            "the model's error on the scene's own views is not finite (NaN); either its weights "
            "are not: give other weights=, or trainer.precision is too low: give 32-true"
        )
    on_step(0, spent())
    average = _weights(adapter)
    best, best_step = _weights(adapter), 0
    step, ended = 0, "steps"
    while step < options.steps and spent() < 1:
        optimizer.param_groups[0]["lr"] = rate * min(1.0, (step + 1) / _WARMUP)
        rng = np.random.default_rng((seed, step))
        batch = pairs.training_batch(options.batch_size, rng)
        batch = compute_warp(batch.to(fabric.device), model.config.image_size)
        draws = StepNoise(torch.Generator().manual_seed(int(rng.integers(2**31))))
        with fabric.autocast():
            anchor = _anchor(batch, anchored)
            loss = diffusion_loss(model, batch, draws, dropout, anchor=anchor)
        optimizer.zero_grad()
        fabric.backward(loss)
        optimizer.step()
        step += 1
        newest = _weights(adapter)
        move_average(average.values(), newest.values(), step, _AVERAGE_DECAY)
        on_step(step, spent())
        if step % options.validate_every and step < options.steps and spent() < 1:
            continue
        peft.set_peft_model_state_dict(adapter, average)
        errors.append((step, measure()))
        if errors[-1][1] < min(error for _, error in errors[:-1]):
            best, best_step = _weights(adapter), step
        peft.set_peft_model_state_dict(adapter, newest)
        if step - best_step >= options.patience * options.validate_every:
            ended = "held-out pair"
            break
    if ended == "steps" and step < options.steps:
        ended = "time"
    peft.set_peft_model_state_dict(adapter, best)
    return Adaptation(errors, best_step, step, clock() - started, ended)


def _anchor(batch: PairBatch, unchanged: Unchanged | None) -> Anchor | None:
    if unchanged is None:
        return None
    assert batch.warp is not None
    return Anchor(batch.warp.mask, unchanged)


_Part = tuple[Tensor, Conditioning, Anchor | None]
"""Part of the held-out pairs: targets, conditioning, and what their holes are held to."""


class _HeldOut:
    """The error on the held-out pairs, of which no more than a training batch is taken at once."""

    def __init__(
        self,
        model: ExtrapolationModel,
        batch: PairBatch,
        most_at_once: int,
        sampler: SamplerConfig,
        fabric: Fabric,
        unchanged: Unchanged | None,
    ) -> None:
        self.model, self.fabric, self.unchanged = model, fabric, unchanged
        levels = sampling_timesteps(model.schedule, sampler)
        levels = levels[:: -(-len(levels) // _LEVELS)].to(fabric.device)
        draws = -(-_DRAWS // len(batch.image))
        split = torch.arange(len(batch.image)).split(most_at_once)
        parts = [self._part(batch, places) for places in split]
        self.taken = [(part, level) for part in parts for level in levels for _ in range(draws)]

    @torch.no_grad()
    def _part(self, batch: PairBatch, places: Int[Tensor, " n"]) -> _Part:
        batch = combine([batch], lambda tensors: tensors[0][places])
        batch = compute_warp(batch.to(self.fabric.device), self.model.config.image_size)
        with self.fabric.autocast():
            conditioning = self.model.condition(batch)
            target = self.model.encode_target(batch, conditioning)
        return target, conditioning, _anchor(batch, self.unchanged)

    def fit_into(self, seconds: float, clock: Callable[[], float]) -> None:
        """Measure on fewer noise levels and draws where all of them would take longer than this."""
        for _ in range(2):  # the first evaluation also loads kernels
            started = clock()
            self._mean(self.taken[:1])
            each = clock() - started
            if each * len(self.taken) <= seconds:
                return
        stride = min(len(self.taken), math.ceil(len(self.taken) * each / seconds))
        self.taken = self.taken[stride // 2 :: stride]

    def __call__(self) -> float:
        return self._mean(self.taken)

    @torch.no_grad()
    def _mean(self, taken: Sequence[tuple[_Part, Int[Tensor, ""]]]) -> float:
        generator = torch.Generator().manual_seed(0)
        errors = [self._errors(*part, level, generator) for part, level in taken]
        return float(torch.cat(errors).mean())

    def _errors(
        self,
        target: Float[Tensor, "b z h w"],
        conditioning: Conditioning,
        anchor: Anchor | None,
        level: Int[Tensor, ""],
        generator: torch.Generator,
    ) -> Float[Tensor, " b"]:
        noise = torch.randn(target.shape, generator=generator).to(target)
        with self.fabric.autocast():
            levels = level.expand(len(target))
            return prediction_errors(self.model, target, noise, levels, conditioning, anchor)


def _weights(adapter: peft.PeftModel) -> dict[str, Tensor]:
    return {k: v.clone() for k, v in peft.get_peft_model_state_dict(adapter).items()}
