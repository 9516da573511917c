"""A model is sampled as it recommends, from its YAML to its saved folder, but for what is said."""

from dataclasses import replace
from pathlib import Path

import hydra
import pytest
from omegaconf import OmegaConf

from benchmarks.methods.diffusion import Diffusion
from extrap_train import open_generator
from extrap_train.cli import register_schemas
from extrap_train.config import ModelConfig, SamplerConfig, TrainConfig, UNetConfig, sampler_for
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import load_model, save_model
from extrap_train.diffusion.training import CategoryTraining
from extrap_train.errors import InputError

_PAPER = SamplerConfig(steps=50, guidance=3.0)
_PUBLISHED = replace(_PAPER, eta=1.0)


def _composed(*options: str) -> TrainConfig:
    register_schemas()
    with hydra.initialize_config_module("conf", version_base="1.3"):
        composed = hydra.compose("train", ["category=hydrant", *options])
    typed = OmegaConf.to_object(composed)
    assert isinstance(typed, TrainConfig)
    return typed


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A tiny model that recommends what the paper samples with."""
    unet = UNetConfig(channels=[16, 32], attention_levels=[False, True], heads=2, token_width=16)
    config = ModelConfig(name="tiny", image_size=32, octaves=2, unet=unet, sampler=_PAPER)
    save_model(ExtrapolationModel(config), tmp_path / "model")
    return tmp_path / "model"


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["model=small"], SamplerConfig(steps=2, guidance=1.0)),
        (["model=ours"], _PAPER),
        (["experiment=paper"], _PAPER),
        (["model=zeronvs"], _PUBLISHED),
        (["model=megascenes"], _PUBLISHED),
        (["model=ours", "sampler.steps=15"], replace(_PAPER, steps=15)),
        (["model=ours", "sampler.guidance=1"], replace(_PAPER, guidance=1.0)),
        (["sampler.steps=4"], SamplerConfig(steps=4)),
    ],
)
def test_the_command_line_says_what_it_wants_otherwise(
    options: list[str], expected: SamplerConfig
) -> None:
    config = _composed(*options)
    assert sampler_for(config.sampler, config.model) == expected


@pytest.mark.parametrize("solver", ["dpmpp", "unipc"])
def test_a_second_order_solver_leaves_out_what_was_recommended_for_ddim(solver: str) -> None:
    config = _composed(
        "model=zeronvs", f"sampler.solver={solver}", "model.sampler.compat=megascenes"
    )
    expected = replace(_PUBLISHED, solver=solver, eta=0.0)
    assert sampler_for(config.sampler, config.model) == expected


@pytest.mark.parametrize("own", ["sampler.eta=0.5", "sampler.compat=megascenes"])
def test_what_is_asked_for_beside_a_second_order_solver_says_what_to_do(own: str) -> None:
    config = _composed("model=zeronvs", "sampler.solver=dpmpp", own)
    with pytest.raises(InputError, match=r"sampler\.eta=0"):
        sampler_for(config.sampler, config.model)


def test_a_saved_model_remembers(folder: Path) -> None:
    assert open_generator(str(folder)).sampler == _PAPER
    assert open_generator(str(folder), sampler=SamplerConfig(steps=7)).sampler.steps == 7
    assert open_generator("base").sampler == SamplerConfig()


def test_it_is_measured_and_compared_so(folder: Path) -> None:
    """Whatever the command would have trained."""
    model = load_model(folder)
    assert CategoryTraining(model, _composed("model=small"), [], None).sampler == _PAPER
    assert Diffusion().sampler(model) == _PAPER
    assert Diffusion(steps=2).sampler(model) == replace(_PAPER, steps=2)
