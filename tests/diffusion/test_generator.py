"""One picture per query, the same whatever else is asked for, and the warp it was made from."""

from dataclasses import replace

import pytest
import torch
from orbits import ring
from torch import nn

from extrap_train.config import NEAREST_ALONE, ModelConfig, SamplerConfig
from extrap_train.diffusion.generator import DiffusionGenerator, ViewGenerator
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.views import Camera, View


def _views(cameras: Camera) -> list[View]:
    size = (cameras.height, cameras.width)
    grey = [torch.full((3, *size), 0.2 + 0.1 * i) for i in range(len(cameras.world_to_cam))]
    return [View(g, cameras[i], torch.full(size, 3.0), name=str(i)) for i, g in enumerate(grey)]


def _generator(config: ModelConfig, batch_size: int) -> DiffusionGenerator:
    torch.manual_seed(0)
    model = ExtrapolationModel(config).eval()
    nn.init.normal_(model.unet.conv_out.weight, std=0.05)
    return DiffusionGenerator(model, SamplerConfig(steps=2), batch_size)


def test_queries_do_not_depend_on_each_other(config: ModelConfig) -> None:
    views = _views(ring(torch.tensor([0.0, 40.0, 80.0]).numpy()))
    queries = ring(torch.tensor([10.0, 30.0, 50.0, 75.0, 100.0]).numpy())
    names = ["a", "b", "c", "d", "e"]
    together = _generator(config, 8).generate(views, queries, names)
    assert together.images.shape == (5, 3, 32, 32)
    assert together.references[0][0] == 0
    assert together.references[4][0] == 2
    assert together.warp.mask.any()
    chunked = _generator(config, 2).generate(views, queries, names)
    torch.testing.assert_close(chunked.images, together.images, atol=1e-5, rtol=0)
    assert chunked.references == together.references
    alone = _generator(config, 8).generate(views, queries[2:3], ["c"])
    torch.testing.assert_close(alone.images[0], together.images[2], atol=1e-5, rtol=0)


def test_fewer_references_than_the_models_may_be_asked_for(config: ModelConfig) -> None:
    views = _views(ring(torch.tensor([0.0, 40.0, 80.0]).numpy()))
    queries = ring(torch.tensor([10.0, 75.0]).numpy())
    assert config.references == 3
    one = replace(_generator(config, 8), references=1).generate(views, queries, ["a", "b"])
    assert one.references == [(0,), (2,)]
    all_three = _generator(config, 8).generate(views, queries, ["a", "b"])
    assert [len(row) for row in all_three.references] == [3, 3]
    assert one.warp.mask.sum() < all_three.warp.mask.sum()


@pytest.mark.parametrize("family", NEAREST_ALONE)
def test_who_is_told_of_the_nearest_alone_makes_its_warp_as_of_one_view(
    config: ModelConfig, family: str
) -> None:
    """At the finer size, then reduced, whatever number of references the configuration says."""
    views = _views(ring(torch.tensor([0.0, 40.0, 80.0]).numpy()))
    query = ring(torch.tensor([10.0]).numpy())
    config = replace(config, family=family, residual=False)
    several, one = (_generator(replace(config, references=count), 8) for count in (3, 1))
    made = several.generate(views, query, ["a"])
    alone = one.generate(views[:1], query, ["a"])
    assert made.references == [(0,)]
    # Kernels may round otherwise in tensors of another shape.
    torch.testing.assert_close(made.warp.image, alone.warp.image, atol=1e-5, rtol=0)
    torch.testing.assert_close(made.images, alone.images, atol=1e-5, rtol=0)


def test_seed_and_name_choose_the_noise(config: ModelConfig) -> None:
    generator = _generator(config, 8)
    views, query = _views(ring(torch.tensor([0.0, 40.0]).numpy())), ring(torch.ones(1).numpy())
    chosen = (("a", 0), ("b", 0), ("a", 1))
    pictures = [generator.generate(views, query, [name], seed).images for name, seed in chosen]
    assert (pictures[0] - pictures[1]).abs().max() > 1e-3
    assert (pictures[0] - pictures[2]).abs().max() > 1e-3
    assert torch.equal(pictures[0], generator.generate(views, query, ["a"], 0).images)


def test_it_is_a_view_generator(config: ModelConfig) -> None:
    assert isinstance(_generator(config, 1), ViewGenerator)
