"""Every task samples with a model whose convolutions lie channels last, and samples the same."""

import torch

from extrap_train import open_generator
from extrap_train.config import ModelConfig, SamplerConfig
from extrap_train.diffusion.model import ExtrapolationModel, use_channels_last
from extrap_train.diffusion.model_files import load_model
from extrap_train.diffusion.packaged import packaged_weights
from extrap_train.diffusion.sampler import sample_views
from extrap_train.views import PairBatch


def _is_arranged(model: ExtrapolationModel) -> bool:
    return model.unet.conv_in.weight.is_contiguous(memory_format=torch.channels_last)


def test_a_generator_s_model_is_arranged() -> None:
    assert not _is_arranged(load_model(packaged_weights("base")))
    assert _is_arranged(open_generator("base").model)


def test_it_generates_the_same(config: ModelConfig, batch: PairBatch) -> None:
    torch.manual_seed(0)
    model = ExtrapolationModel(config).eval()
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.05)

    def generated() -> torch.Tensor:
        return sample_views(model, batch, SamplerConfig(steps=3), "abc")

    before = generated()
    assert use_channels_last(model) is model
    torch.testing.assert_close(generated(), before, atol=1e-4, rtol=0)
