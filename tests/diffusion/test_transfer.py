"""What one family takes over from another answers as it did, wherever both are told the same."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from batches import batch_of

from extrap_train.config import ModelConfig
from extrap_train.diffusion.encoders import PixelPatches
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import initial_model, save_model
from extrap_train.diffusion.pose_encoding import depth_scale, megascenes_pose, zeronvs_pose
from extrap_train.diffusion.transfer import narrowed, turned_pose
from extrap_train.errors import InputError


def _of_family(config: ModelConfig, family: str) -> ModelConfig:
    return replace(config, family=family, residual=family != "zeronvs")


def _saved(config: ModelConfig, folder: Path) -> ExtrapolationModel:
    torch.manual_seed(0)
    model = ExtrapolationModel(config)
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.05)
    save_model(model, folder)
    return model


def test_zeronvs_from_ours_reads_its_channels_alone(config: ModelConfig, tmp_path: Path) -> None:
    """With warp, encoding and mask at zero the wide denoiser says what the narrow one says."""
    ours = _saved(config, tmp_path / "ours")
    start = str(tmp_path / "ours")
    narrow = initial_model(replace(_of_family(config, "zeronvs"), start=start))
    batch = batch_of(2)
    condition = ours.condition(batch)
    latents = condition.latents.clone()
    latents[:, ours.autoencoder.channels :] = 0
    noisy, step = torch.randn(2, 12, 16, 16), torch.tensor([500, 20])
    wide = ours(noisy, step, replace(condition, latents=latents))
    torch.testing.assert_close(narrow(noisy, step, narrow.condition(batch)), wide)


def test_a_patch_of_one_colour_is_answered_as_its_rgb() -> None:
    """Oracle: the wide layer on the encoded picture, its other channels at zero."""
    torch.manual_seed(0)
    patches, layer = PixelPatches(2), torch.randn(8, 2 * 12 + 12 + 5, 3, 3)
    rgb = torch.rand(1, 3, 16, 16)
    wide_input = torch.zeros(1, layer.shape[1], 16, 16)
    wide_input[:, 24:36] = patches.encode(rgb.repeat_interleave(2, -1).repeat_interleave(2, -2))
    narrow_input = torch.cat([torch.zeros(1, 24, 16, 16), rgb * 2 - 1], 1)
    weight = narrowed(layer, patches, "megascenes")
    torch.testing.assert_close(
        torch.nn.functional.conv2d(narrow_input, weight, padding=1),
        torch.nn.functional.conv2d(wide_input, layer, padding=1),
        atol=1e-4,
        rtol=1e-4,
    )


def test_the_turned_projection_reads_megascenes_pose_as_zeronvs() -> None:
    """For cameras so near that nothing is squashed, the lens as near as square pictures come."""
    batch = batch_of(3)
    reference, query = batch.reference_cameras[:, 0], batch.camera
    scale = depth_scale(batch.reference_depths[:, 0], every=1, least=1e-7) * 100
    weight = torch.randn(6, 4 + 19)
    bias = torch.randn(6)
    embedding = torch.zeros(3, 4)
    before = torch.cat([embedding, zeronvs_pose(reference, query, scale)], 1)
    after = torch.cat([embedding, megascenes_pose(reference, query, scale)], 1)
    turned, turned_bias = turned_pose(weight, bias)
    torch.testing.assert_close(
        after @ turned.T + turned_bias, before @ weight.T + bias, atol=0.01, rtol=0
    )
    weight[:, -3:] = 0
    turned, turned_bias = turned_pose(weight, bias)
    assert torch.equal(turned_bias, bias)
    torch.testing.assert_close(after @ turned.T, before @ weight.T, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("fov_deg", [20.0, 33.0, 60.0, 100.0])
def test_the_turned_projection_reads_the_diagonal_as_a_side(fov_deg: float) -> None:
    side = math.radians(fov_deg)
    diagonal = 2 * math.atan(math.sqrt(2) * math.tan(side / 2))
    turned, bias = turned_pose(torch.eye(19), torch.zeros(19))
    told = torch.zeros(19)
    told[-3:] = torch.tensor([diagonal, math.sin(diagonal), math.cos(diagonal)])
    read = (turned @ told + bias)[-3:]
    wanted = torch.tensor([side, math.sin(side), math.cos(side)])
    torch.testing.assert_close(read, wanted, atol=0.006, rtol=0)


@torch.no_grad()
def test_megascenes_from_zeronvs_says_of_a_view_what_zeronvs_said(
    config: ModelConfig, tmp_path: Path
) -> None:
    """Each is fed its own condition: other axes, units and lens, and a warp not heard yet."""
    before = _saved(_of_family(config, "zeronvs"), tmp_path / "zeronvs")
    torch.nn.init.normal_(before.cc_projection.weight)  # so that the pose is heard in the output
    save_model(before, tmp_path / "zeronvs")
    start = str(tmp_path / "zeronvs")
    widened = initial_model(
        replace(config, family="megascenes", residual=False, references=1, start=start)
    )
    batch = batch_of(1, references=1)
    noisy, step = torch.randn(1, 12, 16, 16), torch.tensor([500])
    conditions = [model.condition(batch) for model in (before, widened)]
    tokens = [
        model.cc_projection(condition.embedding)
        for model, condition in zip((before, widened), conditions, strict=True)
    ]
    assert (tokens[1] - tokens[0]).abs().max() < 0.01 * tokens[0].std()
    said = before(noisy, step, conditions[0])
    assert (widened(noisy, step, conditions[1]) - said).abs().max() < 0.01 * said.std()


def test_megascenes_from_ours_has_every_other_layer(config: ModelConfig, tmp_path: Path) -> None:
    ours = _saved(config, tmp_path / "ours")
    start = str(tmp_path / "ours")
    state = initial_model(replace(_of_family(config, "megascenes"), start=start)).state_dict()
    changed = {"unet.conv_in.weight", "cc_projection.weight", "cc_projection.bias"}
    assert state["unet.conv_in.weight"].shape[1] == 12 + 12 + 3
    for name, value in ours.state_dict().items():
        assert name in changed or torch.equal(state[name], value), name


def test_what_was_never_told_the_warp_is_not_narrowed(config: ModelConfig, tmp_path: Path) -> None:
    _saved(_of_family(config, "megascenes"), tmp_path / "model")
    start = str(tmp_path / "model")
    with pytest.raises(InputError, match=r"of the family megascenes.*choose model\.family"):
        initial_model(replace(_of_family(config, "zeronvs"), start=start))
