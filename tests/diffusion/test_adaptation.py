"""A model is adapted to a scene: repeatably, to the best step, within its time and memory."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from batches import random_model
from lightning.fabric import Fabric
from live_bytes import LiveBytes
from orbits import walls
from torch import Tensor

from extrap_train.config import LoraConfig, ModelConfig, SamplerConfig
from extrap_train.data.scene_pairs import adaptation_pairs
from extrap_train.diffusion.adaptation import Adaptation, adapt
from extrap_train.diffusion.lora import add_adapter
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.views import PairBatch

OPTIONS = LoraConfig(rank=2, convolutions=True, steps=12, validate_every=4, batch_size=4)
SAMPLER = SamplerConfig()


def _adapt(
    config: ModelConfig, seconds: float = 1e9, **options: Any
) -> tuple[ExtrapolationModel, Adaptation]:
    model = random_model(config)
    return model, _adapted(model, replace(OPTIONS, **options), seconds)


def _adapted(
    model: ExtrapolationModel,
    options: LoraConfig,
    seconds: float = 1e9,
    sampler: SamplerConfig = SAMPLER,
    views: int = 3,
    **more: Any,
) -> Adaptation:
    return adapt(
        model,
        add_adapter(model, options, seed=0),
        adaptation_pairs(walls(views), 3, options.virtual_references, seed=0),
        options,
        sampler,
        seconds=seconds,
        seed=0,
        fabric=Fabric(accelerator="cpu", devices=1),
        **more,
    )


@pytest.mark.usefixtures("measured_once")
def test_adapting_learns_the_scene_repeatably_and_keeps_the_best(config: ModelConfig) -> None:
    options = {"steps": 8, "learning_rate": 3e-3, "patience": 100, "virtual_references": 2}
    model, done = _adapt(config, **options)
    again, done_again = _adapt(config, **options)
    assert done.held_out_errors == done_again.held_out_errors
    for one, other in zip(model.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)
    losses = dict(done.held_out_errors)
    assert done.best_step > 0
    assert losses[done.best_step] == min(losses.values()) < losses[0]
    assert done.ended == "steps"


@pytest.mark.usefixtures("measured_once")
def test_gradient_checkpointing_learns_the_same_with_less_memory(config: ModelConfig) -> None:
    unet = replace(config.unet, channels=[32, 64])
    peaks, losses = [], []
    for checkpointing in (False, True):
        model = random_model(replace(config, unet=unet))
        if checkpointing:
            model.unet.enable_gradient_checkpointing()
        with LiveBytes(model.parameters()) as live:
            losses.append(_adapted(model, replace(OPTIONS, steps=1, batch_size=8)).held_out_errors)
        peaks.append(live.peak)
    assert losses[1] == losses[0]
    assert peaks[1] < 0.8 * peaks[0]


def _adapter_of(model: ExtrapolationModel) -> dict[str, Tensor]:
    return {name: p.detach() for name, p in model.named_parameters() if ".lora_" in name}


@pytest.mark.usefixtures("measured_once")
def test_it_ends_where_the_held_out_pair_gains_no_more_and_keeps_the_best_step(
    config: ModelConfig,
) -> None:
    """Not the last: its weights are those of a training that ended where the best was."""
    options = {"learning_rate": 30.0, "patience": 2, "virtual_references": 2}
    model, done = _adapt(config, steps=400, **options)
    losses = dict(done.held_out_errors)
    assert done.ended == "held-out pair"
    assert 0 < done.best_step == min(losses, key=losses.__getitem__)
    assert done.steps == done.best_step + 2 * OPTIONS.validate_every
    shorter, ended_there = _adapt(config, steps=done.best_step, **options)
    assert ended_there.best_step == ended_there.steps == done.best_step
    for name, kept in _adapter_of(model).items():
        assert torch.equal(kept, _adapter_of(shorter)[name]), name


@pytest.mark.usefixtures("measured_once")
def test_the_base_is_kept_where_no_step_gains(config: ModelConfig) -> None:
    """A rate that destroys the model at once."""
    model, done = _adapt(config, steps=400, learning_rate=1e8, patience=2)
    assert (done.best_step, done.ended) == (0, "held-out pair")
    assert done.steps == 2 * OPTIONS.validate_every
    written = [p for name, p in _adapter_of(model).items() if ".lora_B" in name]
    assert written
    assert not any(p.any() for p in written)


def test_it_ends_where_the_time_is_up(config: ModelConfig) -> None:
    _, timed = _adapt(config, steps=400, seconds=0.2)
    assert timed.ended == "time"
    assert timed.steps < 400


@pytest.mark.usefixtures("measured_once")
@pytest.mark.parametrize(("steps", "every"), [(5, 25), (7, 3)])
def test_the_last_step_is_measured_and_can_be_kept(
    config: ModelConfig, steps: int, every: int
) -> None:
    rate = {"learning_rate": 3e-3, "patience": 100, "virtual_references": 2}
    _, done = _adapt(config, steps=steps, validate_every=every, **rate)
    assert done.held_out_errors[-1][0] == done.steps == steps
    assert done.best_step == min(done.held_out_errors, key=lambda found: found[1])[0]
    assert done.ended == "steps"


@pytest.mark.parametrize(("budget_s", "evaluations"), [(1e9, 12), (600.0, 6), (60.0, 1), (15.0, 1)])
def test_a_slow_model_is_measured_less_so_that_the_budget_holds(
    config: ModelConfig, budget_s: float, evaluations: int
) -> None:
    """Each run of the denoiser takes ten seconds of a clock; three pairs are measured at once."""
    model, passed = random_model(config), [0.0]

    def tick(*_: object) -> None:
        passed[0] += 5.0

    model.unet.register_forward_pre_hook(tick)
    heard: list[tuple[int, float]] = []
    done = _adapted(
        model,
        replace(OPTIONS, steps=1, virtual_references=8),
        budget_s,
        SamplerConfig(steps=50),
        on_step=lambda step, share: heard.append((step, share)),
        clock=lambda: passed[0],
    )
    assert heard[0][0] == 0
    tried_s = 20.0 if budget_s < 1e9 else 10.0
    assert heard[0][1] * budget_s == pytest.approx(tried_s + 10.0 * evaluations)
    assert done.steps == (1 if heard[0][1] < 1 else 0)
    assert done.ended == ("steps" if done.steps else "time")


def test_a_long_schedule_and_many_held_out_pairs_are_measured_a_batch_at_a_time(
    config: ModelConfig,
) -> None:
    """Fifty steps of a full-size model must not become fifty times the memory."""
    model = random_model(config)
    sizes: list[int] = []
    model.unet.register_forward_pre_hook(lambda _, arguments: sizes.append(len(arguments[0])))
    options = replace(OPTIONS, batch_size=2, steps=1, virtual_references=5)
    _adapted(model, options, sampler=SamplerConfig(steps=50))
    assert max(sizes) == 2
    views_levels_draws = 3 * 4 * 3
    with_and_without_adapter = 2
    measured = 2 * views_levels_draws  # before and after one step
    timed, trained = 2, 2
    assert sum(sizes) == with_and_without_adapter * (measured + timed + trained)


@pytest.mark.usefixtures("measured_once")
@pytest.mark.parametrize("guidance", [1.0, 2.0])
def test_the_null_condition_is_trained_where_sampling_asks_for_it(
    config: ModelConfig, guidance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []

    def loss(
        model: ExtrapolationModel, batch: PairBatch, generator: Any, dropout: float, **anchor: Any
    ) -> Tensor:
        asked.append(dropout)
        return diffusion_loss(model, batch, generator, dropout, **anchor)

    monkeypatch.setattr("extrap_train.diffusion.adaptation.diffusion_loss", loss)
    options = replace(OPTIONS, steps=1, virtual_references=2)
    _adapted(random_model(config), options, sampler=SamplerConfig(guidance=guidance), views=2)
    assert [share > 0 for share in asked] == [guidance != 1]
