"""Each family is told what it was published with, and nothing else reaches its denoiser."""

from dataclasses import replace

import pytest
import torch
from batches import batch_of

from extrap_train.config import ModelConfig, SamplerConfig
from extrap_train.diffusion.conditioning import filled_warp
from extrap_train.diffusion.family import FAMILIES
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.sampler import sample_views
from extrap_train.diffusion.step_noise import StepNoise
from extrap_train.errors import InputError
from extrap_train.geometry.warp import compute_warp
from extrap_train.views import PairBatch


def _model(config: ModelConfig, family: str) -> ExtrapolationModel:
    torch.manual_seed(0)
    model = ExtrapolationModel(replace(config, family=family, residual=False))
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.05)
    return model.eval()


@pytest.mark.parametrize(("family", "channels"), [("zeronvs", 12), ("megascenes", 15)])
def test_a_published_family_trains_and_samples(
    config: ModelConfig, family: str, channels: int
) -> None:
    model, batch = _model(config, family), batch_of(3, references=1)
    condition = model.condition(batch)
    assert condition.latents.shape == (3, channels, 16, 16)
    assert not condition.base.any()
    loss = diffusion_loss(model, batch, StepNoise(torch.Generator().manual_seed(0)), 0.1)
    loss.backward()
    assert loss.isfinite()
    assert model.cc_projection.weight.grad is not None
    image = sample_views(model, batch, SamplerConfig(steps=3, guidance=2.0), "abc")
    assert image.shape == batch.image.shape


@pytest.mark.parametrize("family", FAMILIES)
def test_the_condition_keeps_its_precision_where_the_network_runs_in_less(
    config: ModelConfig, family: str
) -> None:
    """What the small model's networks do not make is the same to the bit: latents are pixels."""
    model, batch = _model(config, family), batch_of(2, references=1)
    exact = model.condition(batch)
    with torch.autocast("cpu", torch.bfloat16):
        lower = model.condition(batch)
    assert torch.equal(lower.latents, exact.latents)
    assert torch.equal(lower.base, exact.base)
    assert torch.equal(lower.embedding[:, -19:], exact.embedding[:, -19:])


def test_zeronvs_sees_the_nearest_reference_alone(config: ModelConfig, batch: PairBatch) -> None:
    others = batch.reference_images.clone()
    others[:, 1:] = 0.5
    changed = compute_warp(replace(batch, reference_images=others, warp=None))
    model = _model(config, "zeronvs")
    before, after = model.condition(batch), model.condition(changed)
    assert torch.equal(before.latents, after.latents)
    assert torch.equal(before.embedding, after.embedding)


def test_megascenes_is_told_the_warp_of_the_nearest_reference(
    config: ModelConfig,
) -> None:
    """Query and reference of one pose: the warp is the photograph, shrunk and in [−1, 1]."""
    batch = batch_of(3, references=1)
    same = replace(
        batch,
        camera=batch.reference_cameras[:, 0],
        reference_depths=torch.full_like(batch.reference_depths, 4.0),
        warp=None,
    )
    latents = _model(config, "megascenes").condition(compute_warp(same)).latents
    photograph = torch.nn.functional.avg_pool2d(batch.reference_images[:, 0], 2) * 2 - 1
    inside = (..., slice(2, -2), slice(2, -2))
    torch.testing.assert_close(latents[:, -3:][inside], photograph[inside], atol=0.05, rtol=0)


def test_the_published_null_keeps_pose_and_warp(config: ModelConfig) -> None:
    condition = _model(config, "megascenes").condition(batch_of(3, references=1))
    null = condition.zeroed(torch.ones(3, dtype=torch.bool))
    assert not null.latents[:, :12].any()
    assert torch.equal(null.latents[:, 12:], condition.latents[:, 12:])
    assert not null.embedding[:, :-19].any()
    assert torch.equal(null.embedding[:, -19:], condition.embedding[:, -19:])


def test_our_null_takes_everything(config: ModelConfig, batch: PairBatch) -> None:
    null = _model(config, "ours").condition(batch).zeroed(torch.ones(3, dtype=torch.bool))
    assert not null.latents.any()
    assert not null.embedding.any()


def test_published_sampling_leaves_the_noisiest_step_out_and_guides_against_zeros(
    config: ModelConfig, batch: PairBatch
) -> None:
    chosen = replace(config, prediction="epsilon", zero_terminal_snr=False)
    model = _model(chosen, "zeronvs")
    seen: list[tuple[int, torch.Tensor]] = []
    model.unet.register_forward_pre_hook(
        lambda _, arguments: seen.append((int(arguments[1][0]), arguments[2]))
    )
    options = SamplerConfig(steps=50, guidance=3.0, compat="megascenes")
    sample_views(model, batch, options, "abc")
    assert [timestep for timestep, _ in seen[:2]] == [961, 941]
    assert len(seen) == 49
    assert all(not token[3:].any() and token[:3].any() for _, token in seen)


def test_views_of_another_size_are_refused(config: ModelConfig, batch: PairBatch) -> None:
    model = _model(replace(config, image_size=64), "ours")
    with pytest.raises(InputError, match=r"views of 32 x 32 pixels.*trained on 64 x 64: resize"):
        model.condition(batch)


def test_a_residual_megascenes_denoises_the_difference_to_its_own_warp(
    config: ModelConfig,
) -> None:
    batch = batch_of(3, references=1)
    assert batch.warp is not None
    model = ExtrapolationModel(replace(config, family="megascenes", residual=True))
    condition = model.condition(batch)
    torch.testing.assert_close(model.autoencoder.decode(condition.base), filled_warp(batch.warp))


def test_megascenes_is_never_told_a_fused_warp(config: ModelConfig, batch: PairBatch) -> None:
    with pytest.raises(ValueError, match="3 references for a model that is told of the nearest"):
        _model(config, "megascenes").condition(batch)
