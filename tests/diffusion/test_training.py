"""A step is a function of its seed, moves every weight, and learns."""

import pytest
import torch

from extrap_train.config import ModelConfig, TrainerConfig
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.step_noise import StepNoise, noise_of_step
from extrap_train.diffusion.training import rate_at
from extrap_train.views import PairBatch


def _draws(seed: int) -> StepNoise:
    return StepNoise(torch.Generator().manual_seed(seed))


def test_the_loss_depends_on_the_seed_and_on_nothing_else(
    config: ModelConfig, batch: PairBatch
) -> None:
    model = ExtrapolationModel(config)
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.1)
    first = diffusion_loss(model, batch, _draws(1), 0.1)
    torch.rand(10)  # the global generator must not matter
    assert torch.equal(first, diffusion_loss(model, batch, _draws(1), 0.1))
    assert not torch.equal(first, diffusion_loss(model, batch, _draws(2), 0.1))


def test_no_two_seeds_or_steps_draw_the_same() -> None:
    """Seeds that lie 64 apart among them: torch reads 32 bits of a number."""
    seeds = (0, 1, 63, 64, 65, 127, 128, 64 * 64, 2**30)
    drawn = {
        tuple(noise_of_step(seed, step).uniform(2).tolist())
        for seed in seeds
        for step in (0, 1, 59_999)
    }
    assert len(drawn) == 3 * len(seeds)


@pytest.mark.parametrize(("seed", "step"), [(0, 0), (3, 1199), (63, 2**20 - 1)])
def test_a_seed_below_64_draws_what_it_always_did(seed: int, step: int) -> None:
    """The packaged weights were trained with these numbers."""
    before = torch.Generator().manual_seed((seed * 2**20 + step) * 64)
    assert torch.equal(noise_of_step(seed, step).uniform(4), torch.rand(4, generator=before))


@pytest.mark.parametrize("world", [2, 3])
def test_processes_share_the_numbers_of_one_that_has_the_whole_batch(world: int) -> None:
    def drawn(rank: int, world: int, count: int) -> list[torch.Tensor]:
        noise = noise_of_step(5, 7, rank, world)
        return [noise.normal((count, 3, 2)), noise.uniform(count), noise.integers(1000, count)]

    whole, parts = drawn(0, 1, 2 * world), [drawn(rank, world, 2) for rank in range(world)]
    for together, *shared in zip(whole, *parts, strict=True):
        assert torch.equal(together, torch.cat(shared))


def test_every_weight_receives_a_gradient(config: ModelConfig, batch: PairBatch) -> None:
    model = ExtrapolationModel(config)
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.1)
    diffusion_loss(model, batch, _draws(0), 0.0).backward()
    # With one token, softmax over keys is constant: queries and keys of cross-attention learn
    # nothing.
    idle = {n for n, p in model.named_parameters() if p.grad is None or not p.grad.any()}
    assert all(".attn2.to_q." in n or ".attn2.to_k." in n or ".norm2." in n for n in idle), idle


def test_without_a_condition_the_image_encoder_learns_nothing(
    config: ModelConfig, batch: PairBatch
) -> None:
    model = ExtrapolationModel(config)
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.1)
    diffusion_loss(model, batch, _draws(0), 1.0).backward()
    assert not any(p.grad is not None and p.grad.any() for p in model.image_encoder.parameters())


def test_training_on_one_batch_lowers_its_loss(config: ModelConfig, batch: PairBatch) -> None:
    """Measured on the same noise before and after, so that luck plays no part."""
    torch.manual_seed(0)
    model = ExtrapolationModel(config)
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)

    def measured() -> float:
        with torch.no_grad():
            losses = [diffusion_loss(model, batch, _draws(1000 + i), 0.0) for i in range(8)]
        return float(torch.stack(losses).mean())

    before = measured()
    for step in range(60):
        optimizer.zero_grad()
        diffusion_loss(model, batch, _draws(step), 0.0).backward()
        optimizer.step()
    assert measured() < 0.6 * before


def test_the_rate_warms_up_stays_and_falls_as_the_inverse_root() -> None:
    options = TrainerConfig(warmup_steps=10, lr_decay_start=100)
    assert rate_at(0, options) == pytest.approx(0.1)
    assert rate_at(9, options) == rate_at(100, options) == 1
    assert rate_at(400, options) == pytest.approx(0.5)
