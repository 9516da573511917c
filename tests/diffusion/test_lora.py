"""An adapter changes what a model generates and never the model; it comes back as it was saved."""

import json
from pathlib import Path
from typing import Any

import peft
import pytest
import torch
from batches import random_model
from torch import Tensor, nn

from extrap_train.config import LoraConfig, ModelConfig, SamplerConfig
from extrap_train.diffusion.lora import (
    AdapterOrigin,
    add_adapter,
    base_hash,
    load_adapter,
    read_adapter_record,
    save_adapter,
)
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.sampler import sample_views
from extrap_train.errors import InputError
from extrap_train.views import PairBatch

OPTIONS = LoraConfig(rank=2, convolutions=True, steps=12, validate_every=4, batch_size=4)


ORIGIN = AdapterOrigin("/scenes/apple", {"a.jpg": "ab", "b.jpg": "cd"}, "ours-apple")


def _generated(model: ExtrapolationModel, batch: PairBatch) -> Tensor:
    return sample_views(model, batch, SamplerConfig(), "abc")


def _randomised(model: ExtrapolationModel) -> peft.PeftModel:
    adapter = add_adapter(model, OPTIONS, seed=0)
    torch.manual_seed(1)
    for name, weight in adapter.named_parameters():
        if "lora_B" in name:
            nn.init.normal_(weight, std=0.1)
    return adapter


def test_a_new_adapter_has_no_effect_and_only_it_learns(
    config: ModelConfig, batch: PairBatch
) -> None:
    model = random_model(config)
    before = _generated(model, batch)
    add_adapter(model, OPTIONS, seed=0)
    torch.testing.assert_close(_generated(model, batch), before)
    learning = {n for n, p in model.named_parameters() if p.requires_grad}
    assert learning
    assert all(".lora_" in name for name in learning)
    assert any("attn1" in name for name in learning)
    assert any("conv1" in name for name in learning)


def test_it_comes_back_as_it_was_saved_and_goes_without_a_trace(
    config: ModelConfig, batch: PairBatch, tmp_path: Path
) -> None:
    model = random_model(config)
    state = {name: value.clone() for name, value in model.state_dict().items()}
    before = _generated(model, batch)
    adapter = _randomised(model)
    adapted = _generated(model, batch)
    assert (adapted - before).abs().max() > 1e-3
    save_adapter(model, adapter, tmp_path / "adapter", ORIGIN)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["adapter"]
    adapter.unload()
    assert all(torch.equal(state[name], value) for name, value in model.state_dict().items())
    fresh = random_model(config)
    load_adapter(fresh, tmp_path / "adapter")
    torch.testing.assert_close(_generated(fresh, batch), adapted)


def test_plain_peft_reads_the_folder(config: ModelConfig, batch: PairBatch, tmp_path: Path) -> None:
    model = random_model(config)
    save_adapter(model, _randomised(model), tmp_path / "adapter", ORIGIN)
    adapted = _generated(model, batch)
    fresh = random_model(config)
    peft.PeftModel.from_pretrained(fresh.unet, str(tmp_path / "adapter"))
    torch.testing.assert_close(_generated(fresh, batch), adapted)


def test_other_weights_and_other_folders_are_refused(config: ModelConfig, tmp_path: Path) -> None:
    model = random_model(config)
    save_adapter(model, _randomised(model), tmp_path / "adapter", ORIGIN)
    other = random_model(config)
    nn.init.normal_(other.unet.conv_out.weight, std=0.1)
    with pytest.raises(InputError, match="was trained on other weights"):
        load_adapter(other, tmp_path / "adapter")
    unlike = random_model(config)
    nn.init.normal_(unlike.cc_projection.weight, std=0.1)  # what the adapted layers attend to
    with pytest.raises(InputError, match="was trained on other weights"):
        load_adapter(unlike, tmp_path / "adapter")
    with pytest.raises(InputError, match="is not an adapter folder of task=scene"):
        load_adapter(random_model(config), tmp_path / "gone")
    weights = tmp_path / "adapter" / "adapter_model.safetensors"
    weights.write_bytes(weights.read_bytes()[:100])
    with pytest.raises(InputError, match="is not an adapter folder of task=scene"):
        load_adapter(random_model(config), tmp_path / "adapter")


def test_an_adapter_says_what_it_was_made_from(config: ModelConfig, tmp_path: Path) -> None:
    model = random_model(config)
    folder = tmp_path / "adapter"
    save_adapter(model, _randomised(model), folder, ORIGIN)
    record = read_adapter_record(folder)
    assert vars(ORIGIN).items() <= vars(record).items()
    assert record.base == base_hash(model)


@pytest.mark.parametrize("changed", ["flip", "cut", "gone", "folder"])
def test_an_adapter_whose_tensors_were_changed_is_refused(
    config: ModelConfig, tmp_path: Path, changed: str
) -> None:
    """One bit gives another picture, and no error of its own."""
    model = random_model(config)
    save_adapter(model, _randomised(model), tmp_path, ORIGIN)
    file = tmp_path / "adapter_model.safetensors"
    content = bytearray(file.read_bytes())
    content[-5] ^= 64
    file.unlink()
    if changed == "folder":
        file.mkdir()
    elif changed != "gone":
        file.write_bytes(content if changed == "flip" else content[:-1])
    with pytest.raises(InputError, match=r"adapter_model\.safetensors: "):
        load_adapter(random_model(config), tmp_path)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"r": 3, "lora_alpha": 3}, "tensors do not fit"),
        ({"lora_alpha": 1000}, "lora_alpha is 1000"),
        ({"r": 0}, "r: "),
        ({"r": 10**9, "lora_alpha": 10**9}, "r: "),
        ({"lora_alpha": int("9" * 400)}, "lora_alpha: "),
        ({"r": "many"}, "r: "),
        ({"r": True}, "r: "),
        ({"peft_type": "IA3"}, "peft_type: "),
        ({"peft_type": "NONE"}, "peft_type: "),
        ({"target_modules": ["conv_in"]}, "target_modules.0: "),
        ({"target_modules": None}, "target_modules: "),
        ({"target_modules": []}, "target_modules: "),
        ({"target_modules": ["to_q"]}, "tensors do not fit"),
    ],
)
def test_an_adapter_of_another_kind_is_refused_and_leaves_the_model_alone(
    config: ModelConfig, batch: PairBatch, tmp_path: Path, changed: dict[str, Any], said: str
) -> None:
    model = random_model(config)
    save_adapter(model, _randomised(model), tmp_path / "adapter", ORIGIN)
    file = tmp_path / "adapter" / "adapter_config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changed))
    model = random_model(config)
    names = list(model.state_dict())
    with pytest.raises(InputError, match=said) as raised:
        load_adapter(model, tmp_path / "adapter")
    assert "\n" not in str(raised.value)
    assert list(model.state_dict()) == names
