"""What cannot be started from is refused in one line that says what, where and what to do."""

import os
import sys
import types
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from published_networks import Reference, tiny_config
from safetensors.torch import save_file
from torch import Tensor

from extrap_train.config import ModelConfig
from extrap_train.diffusion.model_files import initial_model
from extrap_train.errors import InputError

_FIRST = "model.diffusion_model.input_blocks.0.0.weight"


@pytest.fixture
def state(references: dict[str, Reference]) -> dict[str, Tensor]:
    return dict(references["zeronvs"].state)


def _config(path: Path, family: str = "zeronvs") -> ModelConfig:
    return tiny_config(family, start=str(path))


def _refusal(config: ModelConfig) -> str:
    with pytest.raises(InputError) as raised:
        initial_model(config)
    message = str(raised.value)
    assert "\n" not in message
    assert str(config.start) in message
    assert "model.start" in message
    return message


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
@pytest.mark.parametrize("suffix", ["ckpt", "safetensors"])
def test_any_precision_trains_in_float32(
    state: dict[str, Tensor], tmp_path: Path, dtype: torch.dtype, suffix: str
) -> None:
    path = tmp_path / f"zeronvs.{suffix}"
    typed = {name: x.to(dtype) for name, x in state.items()}
    if suffix == "ckpt":
        torch.save({"state_dict": typed}, path)
    else:
        save_file(typed, path)
    model = initial_model(_config(path))
    assert {x.dtype for part in model.parts().values() for x in part.parameters()} == {
        torch.float32
    }
    assert torch.equal(model.unet.conv_in.weight, typed[_FIRST].float())


def test_a_published_file_is_not_asked_what_our_folders_say(
    state: dict[str, Tensor], tmp_path: Path
) -> None:
    """It has no configuration beside it, whatever the model's own wants to know of the start."""
    torch.save({"state_dict": state}, tmp_path / "zeronvs.ckpt")
    model = initial_model(replace(_config(tmp_path / "zeronvs.ckpt"), geometry=True))
    assert torch.equal(model.unet.conv_in.weight, state[_FIRST])


def test_averages_and_schedules_beside_the_weights_are_ignored(
    state: dict[str, Tensor], tmp_path: Path
) -> None:
    state |= {"model_ema.diffusion_modelinput_blocks00weight": torch.zeros(1)}
    state |= {"cond_stage_model.model.token_embedding.weight": torch.zeros(1)}
    torch.save({"state_dict": state}, tmp_path / "zeronvs.ckpt")
    assert torch.equal(
        initial_model(_config(tmp_path / "zeronvs.ckpt")).unet.conv_in.weight, state[_FIRST]
    )


def test_old_lightning_s_remarks_are_read_without_lightning(
    state: dict[str, Tensor], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before 1.5 it used the callback's class as a key; the class need not exist any more."""
    name = "pytorch_lightning.callbacks.model_checkpoint"
    module = types.ModuleType(name)
    module.ModelCheckpoint = type("ModelCheckpoint", (), {"__module__": name})  # type: ignore[attr-defined]
    with monkeypatch.context() as context:
        context.setitem(sys.modules, name, module)
        callbacks = {module.ModelCheckpoint: {"monitor": "val/loss"}}
        torch.save({"state_dict": state, "callbacks": callbacks}, tmp_path / "zeronvs.ckpt")
    initial_model(_config(tmp_path / "zeronvs.ckpt"))


class Bomb:
    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (f"touch {self.target}",)


def test_code_does_not_run(state: dict[str, Tensor], tmp_path: Path) -> None:
    path = tmp_path / "zeronvs.ckpt"
    torch.save({"state_dict": state, "hyper_parameters": Bomb(tmp_path / "ran")}, path)
    assert "could run code" in _refusal(_config(path))
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("suffix", ["ckpt", "safetensors"])
def test_truncated(state: dict[str, Tensor], tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"zeronvs.{suffix}"
    if suffix == "ckpt":
        torch.save({"state_dict": state}, path)
    else:
        save_file(state, path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert "cut off" in _refusal(_config(path))


def test_missing_tensors_are_counted_and_the_first_five_named(
    state: dict[str, Tensor], tmp_path: Path
) -> None:
    gone = [name for name in state if ".middle_block." in name]
    torch.save({k: x for k, x in state.items() if k not in gone}, tmp_path / "zeronvs.ckpt")
    message = _refusal(_config(tmp_path / "zeronvs.ckpt"))
    assert f"lacks {len(gone)} of " in message
    assert message.count("unet.mid_block.") == 5
    assert "of another size" in message


@pytest.mark.parametrize(
    ("prefix", "said"),
    [
        ("first_stage_model.", "exported without the autoencoder"),
        ("cond_stage_model.", "exported without CLIP's image tower"),
        ("cc_projection.", "exported without the projection of pose and image"),
    ],
)
def test_a_missing_network_is_named(
    state: dict[str, Tensor], tmp_path: Path, prefix: str, said: str
) -> None:
    rest = {name: x for name, x in state.items() if not name.startswith(prefix)}
    torch.save({"state_dict": rest}, tmp_path / "zeronvs.ckpt")
    assert said in _refusal(_config(tmp_path / "zeronvs.ckpt"))


def test_a_text_to_image_model_is_told_apart(state: dict[str, Tensor], tmp_path: Path) -> None:
    text = {k: x for k, x in state.items() if not k.startswith(("cond_stage", "cc_projection"))}
    text["cond_stage_model.transformer.text_model.final_layer_norm.bias"] = torch.zeros(1)
    torch.save({"state_dict": text}, tmp_path / "sd.ckpt")
    assert "text-to-image" in _refusal(_config(tmp_path / "sd.ckpt"))


def test_zero123_s_shorter_pose_is_another_shape(state: dict[str, Tensor], tmp_path: Path) -> None:
    state["cc_projection.weight"] = torch.zeros(768, 772)
    torch.save({"state_dict": state}, tmp_path / "zero123.ckpt")
    assert "[768, 772], not [768, 787]" in _refusal(_config(tmp_path / "zero123.ckpt"))


def test_a_larger_network_is_another_size(state: dict[str, Tensor], tmp_path: Path) -> None:
    state["first_stage_model.decoder.up.4.block.0.norm1.weight"] = torch.zeros(1)
    torch.save({"state_dict": state}, tmp_path / "zeronvs.ckpt")
    assert "1 tensors more" in _refusal(_config(tmp_path / "zeronvs.ckpt"))


@pytest.mark.parametrize("family", ["zeronvs", "ours"])
def test_another_family_is_refused(
    references: dict[str, Reference], tmp_path: Path, family: str
) -> None:
    torch.save(references["megascenes"].state, tmp_path / "pytorch_model.bin")
    message = _refusal(_config(tmp_path, family))
    assert "is of the family megascenes (11 input channels)" in message
    assert "choose model.family=megascenes" in message


def test_a_denoiser_of_no_family(state: dict[str, Tensor], tmp_path: Path) -> None:
    state[_FIRST] = state[_FIRST][:, :4]
    torch.save({"state_dict": state}, tmp_path / "sd.ckpt")
    assert "takes 4 channels" in _refusal(_config(tmp_path / "sd.ckpt"))


def test_no_weights_at_all() -> None:
    with pytest.raises(InputError, match=r"pretrained networks: give model\.start=PATH, ZeroNVS"):
        initial_model(replace(tiny_config("zeronvs"), start=None))


def test_a_folder_of_something_else(tmp_path: Path) -> None:
    assert "neither a file or folder of weights" in _refusal(_config(tmp_path))
