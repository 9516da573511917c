"""Every network of both families computes what the published code computed, from the file that a
user downloads: within 1e-4 of each output's spread.
"""

from dataclasses import replace
from pathlib import Path

import kornia
import pytest
import torch
from batches import batch_of
from published_networks import Reference, tiny_config
from torch import Tensor

from extrap_train.config import SamplerConfig
from extrap_train.diffusion.conditioning import Conditioning
from extrap_train.diffusion.encoders import clip_input
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import initial_model
from extrap_train.diffusion.sampler import ddim_timesteps, guided_denoiser, sample_ddim
from extrap_train.diffusion.step_noise import StepNoise


def assert_parity(ours: Tensor, expected: Tensor) -> None:
    assert ours.shape == expected.shape
    assert float((ours - expected).abs().max()) <= 1e-4 * float(expected.std())


@pytest.fixture(scope="module")
def model(reference: Reference, checkpoint: Path) -> ExtrapolationModel:
    config = tiny_config(reference.family, start=str(checkpoint))
    return initial_model(config).eval()


@torch.no_grad()
def test_every_network(model: ExtrapolationModel, reference: Reference) -> None:
    given = reference.expected
    vae = model.parts()["vae"]
    posterior = vae.encode(given["image"]).latent_dist
    assert_parity(posterior.mean, given["vae_mean"])
    assert_parity(posterior.logvar, given["vae_logvar"])
    assert_parity(vae.decode(given["latent"]).sample, given["vae_decoded"])
    embedding = model.parts()["image_encoder"](given["clip_input"]).image_embeds
    assert_parity(embedding, given["clip_embedding"])
    token = model.cc_projection(torch.cat([given["clip_embedding"], given["pose"]], -1))
    assert_parity(token[:, None], given["token"])
    token = given["token"].expand(2, -1, -1)
    output = model.unet(given["unet_input"], given["unet_timestep"], token).sample
    assert_parity(output, given["unet_output"])


@torch.no_grad()
def test_the_latent_conventions(model: ExtrapolationModel, reference: Reference) -> None:
    """What is denoised is scaled, the reference is not."""
    given = reference.expected
    image = given["image"] / 2 + 0.5
    assert_parity(model.autoencoder.encode(image), 0.18215 * given["vae_mean"])
    assert_parity(model.autoencoder.encode_reference(image), given["vae_mean"])
    decoded = model.autoencoder.decode(0.18215 * given["latent"])
    assert_parity(decoded * 2 - 1, given["vae_decoded"])


@torch.no_grad()
def test_a_drawn_latent_is_the_posterior_s(model: ExtrapolationModel, reference: Reference) -> None:
    image = reference.expected["image"] / 2 + 0.5
    drawn = model.autoencoder.encode(image, StepNoise(torch.Generator().manual_seed(0))) / 0.18215
    noise = torch.randn(drawn.shape, generator=torch.Generator().manual_seed(0))
    spread = (0.5 * reference.expected["vae_logvar"]).exp()
    assert_parity(drawn, reference.expected["vae_mean"] + spread * noise)


def test_nine_steps_as_published(model: ExtrapolationModel, reference: Reference) -> None:
    given = reference.expected
    condition = Conditioning(
        given["ddim_concat"],
        torch.cat([given["clip_embedding"], given["pose"]], -1),
        torch.zeros_like(given["ddim_noise"]),
        torch.ones(1),
        model.null,
    )
    visited = []
    hook = model.unet.register_forward_pre_hook(lambda _, step: visited.append(int(step[1][0])))
    options = SamplerConfig(steps=10, eta=0.0, guidance=3.0, compat="megascenes")
    with torch.no_grad():
        latent = sample_ddim(
            guided_denoiser(model, condition, options),
            model.schedule,
            ddim_timesteps(model.schedule, options),
            options.eta,
            lambda: given["ddim_noise"],
        )
    hook.remove()
    assert sorted(visited) == sorted(given["ddim_timesteps"].tolist())
    assert_parity(latent, given["ddim_latent"])


def test_clip_sees_what_zero123_shows_it() -> None:
    """kornia is what the published code resamples with."""
    image = torch.rand(1, 3, 256, 256, generator=torch.Generator().manual_seed(0))
    resized = kornia.geometry.resize(
        image, (224, 224), interpolation="bicubic", align_corners=True, antialias=False
    )
    mean = torch.tensor([0.48145466, 0.4578275, 0.40821073])
    std = torch.tensor([0.26862954, 0.26130258, 0.27577711])
    expected = kornia.enhance.normalize(resized, mean, std)
    torch.testing.assert_close(clip_input(image), expected, atol=1e-5, rtol=0)


@torch.no_grad()
@pytest.mark.parametrize("family", ["ours", "megascenes"])
def test_widening_leaves_the_output_as_it_was(
    references: dict[str, Reference], tmp_path: Path, family: str
) -> None:
    """Whatever the new channels say, the widened denoiser starts as ZeroNVS's, but for rounding: a
    convolution of more channels adds its zeros in another order.
    """
    path = tmp_path / "zeronvs.ckpt"
    torch.save({"state_dict": references["zeronvs"].state}, path)
    start = tiny_config("zeronvs", start=str(path))
    published = initial_model(start).eval()
    widened = initial_model(replace(start, family=family)).eval()
    extra = widened.unet.conv_in.in_channels - 8
    assert extra == {"ours": 37, "megascenes": 3}[family]
    given = references["zeronvs"].expected
    token = given["token"].expand(2, -1, -1)
    told = torch.cat([given["unet_input"], torch.randn(2, extra, 32, 32)], 1)
    before = published.unet(given["unet_input"], given["unet_timestep"], token).sample
    after = widened.unet(told, given["unet_timestep"], token).sample
    torch.testing.assert_close(after, before, atol=1e-5 * float(before.std()), rtol=0)


@torch.no_grad()
def test_ours_says_of_a_view_what_zeronvs_said_before_it_is_trained(
    references: dict[str, Reference], tmp_path: Path
) -> None:
    """The whole models, each with its own condition: photographs, poses, CLIP, VAE and token."""
    path = tmp_path / "zeronvs.ckpt"
    torch.save({"state_dict": references["zeronvs"].state}, path)
    start = tiny_config("zeronvs", start=str(path))
    views, noisy, step = batch_of(1, size=256), torch.randn(1, 4, 32, 32), torch.tensor([500])
    said = []
    for family in ("zeronvs", "ours"):
        model = initial_model(replace(start, family=family)).eval()
        said.append(model(noisy, step, model.condition(views)))
    assert said[0].std() > 1e-3
    torch.testing.assert_close(said[1], said[0], atol=1e-5 * float(said[0].std()), rtol=0)
