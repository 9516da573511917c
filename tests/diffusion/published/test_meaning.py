"""What a diffusers folder says of its networks is heard, where the tensors do not say it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from published_networks import Reference, tiny_config

from extrap_train.config import ModelConfig
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import (
    initial_model,
    load_weights,
    published_model,
    save_model,
)
from extrap_train.errors import InputError


@pytest.fixture(scope="module")
def saved(references: dict[str, Reference], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plain diffusers folder: our own configuration does not lie beside it."""
    folder = tmp_path_factory.mktemp("plain")
    torch.save(references["zeronvs"].state, folder / "zeronvs.ckpt")
    model = initial_model(tiny_config("zeronvs", start=str(folder / "zeronvs.ckpt")))
    save_model(model, folder / "model")
    (folder / "model" / "extrapolation_model.json").unlink()
    return folder / "model"


@pytest.fixture
def config(saved: Path, tmp_path: Path) -> ModelConfig:
    """The configuration of a copy whose files may be changed."""
    shutil.copytree(saved, tmp_path / "model")
    return tiny_config("zeronvs", start=str(tmp_path / "model"))


@pytest.fixture(scope="module")
def network() -> ExtrapolationModel:
    """What is asked for; it is filled by no test."""
    with torch.device("meta"):
        return ExtrapolationModel(tiny_config("zeronvs"))


def _rewrite(config: ModelConfig, file: str, change: dict[str, Any], *gone: str) -> Path:
    path = Path(str(config.start)) / file
    said = json.loads(path.read_text()) | change
    path.write_text(json.dumps({key: value for key, value in said.items() if key not in gone}))
    return path


@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        (
            "scheduler/scheduler_config.json",
            {"prediction_type": "v_prediction"},
            "prediction_type=v_prediction, but the model that is asked for has epsilon: give "
            "model.prediction=v_prediction",
        ),
        (
            "unet/config.json",
            {"attention_head_dim": 4},
            "attention_head_dim=4, but the model that is asked for has 8: give model.unet.heads=4",
        ),
        (
            "unet/config.json",
            {"attention_head_dim": [5, 10, 20, 20]},
            "attention_head_dim=[5, 10, 20, 20], but",
        ),
        ("unet/config.json", {"num_attention_heads": 2}, "attention_head_dim=2, but"),
        ("unet/config.json", {"act_fn": "gelu"}, "act_fn=gelu, but the model that is asked"),
        (
            "vae/config.json",
            {"scaling_factor": 0.13025},
            "scaling_factor=0.13025, but the model that is asked for has 0.18215: no option",
        ),
        ("vae/config.json", {"shift_factor": 0.06}, "shift_factor=0.06, but"),
        ("image_encoder/config.json", {"hidden_act": "gelu"}, "hidden_act=gelu, but"),
        ("image_encoder/config.json", {"vision_config": {"num_attention_heads": 4}}, "=4, but"),
        ("scheduler/scheduler_config.json", {"beta_end": 0.02}, "beta_end=0.02, but"),
    ],
)
def test_another_meaning_is_refused(
    network: ExtrapolationModel, config: ModelConfig, file: str, change: dict[str, Any], said: str
) -> None:
    path = _rewrite(config, file, change)
    for to_train in (True, False):
        with pytest.raises(InputError) as raised:
            load_weights(network, path.parents[1], to_train=to_train)
        message = str(raised.value)
        assert message.startswith(f"{path}: ")
        assert said in message
        assert "\n" not in message


def test_what_a_file_leaves_out_is_diffusers_default(config: ModelConfig) -> None:
    _rewrite(config, "scheduler/scheduler_config.json", {}, "beta_schedule")
    with pytest.raises(InputError, match=r"beta_schedule=linear, but .* has scaled_linear"):
        initial_model(config)
    _rewrite(config, "scheduler/scheduler_config.json", {"beta_schedule": "scaled_linear"})
    _rewrite(config, "unet/config.json", {}, "attention_head_dim", "norm_eps")
    initial_model(config)  # 8 and 1e-5


def test_the_same_meaning_in_other_words_is_taken(config: ModelConfig) -> None:
    _rewrite(config, "unet/config.json", {"attention_head_dim": [8] * 4, "sample_size": 64})
    _rewrite(config, "scheduler/scheduler_config.json", {"_class_name": "PNDMScheduler"})
    (Path(str(config.start)) / "vae" / "config.json").unlink()  # says nothing
    initial_model(config)


def test_a_model_may_be_trained_on_to_zero_terminal_snr_but_is_not_used_so(
    config: ModelConfig,
) -> None:
    _rewrite(config, "scheduler/scheduler_config.json", {"prediction_type": "v_prediction"})
    other = replace(config, prediction="v_prediction", zero_terminal_snr=True)
    initial_model(other)
    with pytest.raises(InputError, match=r"rescale_betas_zero_snr=False.*zero_terminal_snr=False"):
        published_model(str(config.start), other)


@pytest.mark.parametrize("text", ["{", "[1]", "3"])
def test_a_damaged_file_is_named(config: ModelConfig, text: str) -> None:
    path = Path(str(config.start)) / "unet" / "config.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"download it again|check the file") as raised:
        initial_model(config)
    assert str(raised.value).startswith(f"{path}: ")
