"""Views that are denoised together: what they may know of each other, and what nobody else may."""

from dataclasses import replace

import pytest
import torch
from batches import batch_of
from jaxtyping import Float
from torch import Tensor, nn

from extrap_train.config import ModelConfig, SamplerConfig
from extrap_train.diffusion.checkpoint import load_model, save_model
from extrap_train.diffusion.conditioning import Conditioning
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.sampler import sample_views, view_generator
from extrap_train.views import PairBatch, combine


def _model(config: ModelConfig, joint_views: int) -> ExtrapolationModel:
    torch.manual_seed(0)
    model = ExtrapolationModel(replace(config, joint_views=joint_views)).eval()
    nn.init.normal_(model.unet.conv_out.weight, std=0.1)
    return model


def _grouped(batch: PairBatch, joint_views: int) -> PairBatch:
    return replace(batch, joint_views=joint_views)


def _predicted(
    model: ExtrapolationModel, noisy: Float[Tensor, "b z h w"], conditioning: Conditioning
) -> Float[Tensor, "b z h w"]:
    return model(noisy, torch.full((len(noisy),), 700), conditioning)


@pytest.fixture
def four() -> PairBatch:
    return batch_of(4)


def _noisy(batch: PairBatch, model: ExtrapolationModel) -> Tensor:
    shape = model.condition(batch).base.shape
    return torch.randn(shape, generator=torch.Generator().manual_seed(1))


def test_a_group_of_one_is_the_model_of_single_views(config: ModelConfig, four: PairBatch) -> None:
    single, joint = _model(config, 1), _model(config, 2)
    joint.load_state_dict(single.state_dict())  # strict: no weight more or less
    noisy = _noisy(four, single)
    with torch.no_grad():
        wanted = _predicted(single, noisy, single.condition(four))
        assert torch.equal(_predicted(joint, noisy, joint.condition(four)), wanted)
        together = _predicted(joint, noisy, joint.condition(_grouped(four, 2)))
    assert (together - wanted).abs().max() > 1e-3


def test_alike_views_tell_each_other_nothing(config: ModelConfig) -> None:
    """The mean over a token and its twin is the token's own: attention is not summed."""
    model, one = _model(config, 3), batch_of(1)
    thrice = combine([one] * 3, lambda tensors: torch.cat(list(tensors)))
    noisy = _noisy(one, model)
    with torch.no_grad():
        alone = _predicted(model, noisy, model.condition(one))
        conditioning = model.condition(_grouped(thrice, 3))
        together = _predicted(model, noisy.expand(3, -1, -1, -1), conditioning)
    torch.testing.assert_close(together, alone.expand(3, -1, -1, -1), atol=1e-5, rtol=0)


def test_permuting_a_group_permutes_its_predictions(config: ModelConfig, four: PairBatch) -> None:
    model, order = _model(config, 4), torch.tensor([2, 0, 3, 1])
    permuted = combine([four], lambda tensors: tensors[0][order])
    noisy = _noisy(four, model)
    with torch.no_grad():
        plain = _predicted(model, noisy, model.condition(_grouped(four, 4)))
        other = _predicted(model, noisy[order], model.condition(_grouped(permuted, 4)))
    torch.testing.assert_close(other, plain[order], atol=1e-5, rtol=0)


@pytest.mark.parametrize("doubled", [False, True])
def test_only_the_views_of_a_group_know_of_each_other(
    config: ModelConfig, four: PairBatch, doubled: bool
) -> None:
    """Neither another scene's views nor, in guidance, the null condition's are looked at."""
    model = _model(config, 2)
    conditioning = model.condition(_grouped(four, 2))
    noisy = _noisy(four, model)
    if doubled:
        conditioning, noisy = conditioning.doubled(), torch.cat([noisy, noisy])
    noisy.requires_grad_()
    _predicted(model, noisy, conditioning)[1].sum().backward()
    assert noisy.grad is not None
    moved = noisy.grad.abs().amax((1, 2, 3)) > 0
    assert moved.tolist() == [True, True] + [False] * (len(noisy) - 2)


def test_a_group_shares_its_noise_level_and_its_null_condition(
    config: ModelConfig, four: PairBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = _model(config, 2)
    seen: list[tuple[Tensor, Conditioning]] = []
    plain = ExtrapolationModel.forward

    def spied(
        self: ExtrapolationModel, noisy: Tensor, timestep: Tensor, conditioning: Conditioning
    ) -> Tensor:
        seen.append((timestep, conditioning))
        return plain(self, noisy, timestep, conditioning)

    monkeypatch.setattr(ExtrapolationModel, "forward", spied)
    for seed in range(4):
        diffusion_loss(model, _grouped(four, 2), torch.Generator().manual_seed(seed), 0.5)
    assert len({int(timestep[0]) for timestep, _ in seen}) == 4
    dropped = []
    for timestep, conditioning in seen:
        assert timestep[0] == timestep[1] != timestep[2] == timestep[3]
        null = (conditioning.embedding == 0).all(1)
        assert null[0] == null[1]
        assert null[2] == null[3]
        dropped += [bool(null[0]), bool(null[2])]
    assert set(dropped) == {True, False}


def test_every_view_is_learnt_from(config: ModelConfig, four: PairBatch) -> None:
    model = _model(config, 2).train()
    model.unet.enable_gradient_checkpointing()
    checkpointed = diffusion_loss(model, _grouped(four, 2), torch.Generator().manual_seed(0), 0.0)
    checkpointed.backward()
    gradients = {n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None}
    assert all(g.any() for n, g in gradients.items() if ".attn1." in n)
    model.unet.disable_gradient_checkpointing()
    model.zero_grad()
    diffusion_loss(model, _grouped(four, 2), torch.Generator().manual_seed(0), 0.0).backward()
    for name, parameter in model.named_parameters():
        if name in gradients:
            torch.testing.assert_close(parameter.grad, gradients[name], atol=1e-6, rtol=1e-4)


def test_a_groups_views_are_sampled_from_their_own_noise(
    config: ModelConfig, four: PairBatch
) -> None:
    """Another group beside it changes nothing; other noise of a neighbour does."""
    model = _model(config, 2)

    def sampled(batch: PairBatch, names: str) -> Tensor:
        generators = [view_generator(0, name) for name in names]
        return sample_views(model, _grouped(batch, 2), SamplerConfig(guidance=2.0), generators)

    both = sampled(four, "abcd")
    pair = combine([four], lambda tensors: tensors[0][:2])
    torch.testing.assert_close(sampled(pair, "ab"), both[:2], atol=1e-5, rtol=0)
    assert (sampled(pair, "ax")[0] - both[0]).abs().max() > 1e-4


def test_a_model_on_disk_keeps_its_groups(
    config: ModelConfig, four: PairBatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    model, folder = _model(config, 2), tmp_path_factory.mktemp("saved") / "model"
    save_model(model, folder)
    loaded = load_model(folder).eval()
    noisy = _noisy(four, model)
    with torch.no_grad():
        made = [_predicted(m, noisy, m.condition(_grouped(four, 2))) for m in (model, loaded)]
    assert torch.equal(made[0], made[1])


def test_groups_are_refused_by_a_model_of_single_views(
    config: ModelConfig, four: PairBatch
) -> None:
    with pytest.raises(ValueError, match="groups of 2"):
        _model(config, 1).condition(_grouped(four, 2))
