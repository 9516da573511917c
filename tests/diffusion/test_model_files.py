"""A saved model is a diffusers folder, loads strictly, and says in one line what does not fit."""

import errno
import json
import os
import stat
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers import DDIMScheduler, UNet2DConditionModel

from extrap_train.config import ModelConfig
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import initial_model, load_model, save_model
from extrap_train.errors import InputError
from extrap_train.views import PairBatch


def test_a_model_comes_back_as_it_was(config: ModelConfig, tmp_path: Path) -> None:
    model = ExtrapolationModel(config)
    save_model(model, tmp_path / "model")
    loaded = load_model(tmp_path / "model")
    assert loaded.config == config
    for (name, before), after in zip(
        model.state_dict().items(), loaded.state_dict().values(), strict=True
    ):
        assert torch.equal(before, after), name
    left = {path.name for path in tmp_path.iterdir()} - {".lock"}
    assert left == {"model"}, "nothing half-written is left"


def test_a_model_that_lies_elsewhere_by_a_link_is_replaced_there(
    config: ModelConfig, tmp_path: Path
) -> None:
    elsewhere, link = tmp_path / "disk" / "model", tmp_path / "run" / "model"
    save_model(ExtrapolationModel(config), elsewhere)
    link.parent.mkdir()
    link.symlink_to(elsewhere)
    newer = ExtrapolationModel(config)
    save_model(newer, link)
    assert link.is_symlink()
    assert torch.equal(load_model(elsewhere).unet.conv_in.weight, newer.unet.conv_in.weight)


def test_plain_diffusers_loads_the_folder(config: ModelConfig, tmp_path: Path) -> None:
    model = ExtrapolationModel(config)
    save_model(model, tmp_path / "model")
    unet = UNet2DConditionModel.from_pretrained(tmp_path / "model" / "unet")
    schedule = DDIMScheduler.from_pretrained(tmp_path / "model" / "scheduler")
    assert torch.equal(unet.conv_in.weight, model.unet.conv_in.weight)
    assert schedule.config.prediction_type == config.prediction
    assert float(schedule.alphas_cumprod[-1]) == pytest.approx(0, abs=1e-6)


def test_half_precision_on_disk_leaves_the_model_alone(config: ModelConfig, tmp_path: Path) -> None:
    model = ExtrapolationModel(config)
    save_model(model, tmp_path / "model", torch.float16)
    assert model.unet.conv_in.weight.dtype == torch.float32
    loaded = load_model(tmp_path / "model").unet.conv_in.weight
    assert loaded.dtype == torch.float32
    torch.testing.assert_close(loaded, model.unet.conv_in.weight, atol=1e-3, rtol=1e-3)


def test_weights_of_another_shape_are_refused(config: ModelConfig, tmp_path: Path) -> None:
    save_model(ExtrapolationModel(config), tmp_path / "model")
    other = replace(config, octaves=5, start=str(tmp_path / "model"))
    with pytest.raises(InputError, match=r"another network's.*conv_in"):
        initial_model(other)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"prediction": "v_prediction"}, "prediction=sample, .* model.prediction=v_prediction"),
        ({"residual": False}, "residual=True, .* model.residual=False"),
        ({"unet": {"heads": 4}}, "unet.heads=2, .* model.unet.heads=4"),
        ({"unet": {"norm_groups": 8}}, "unet.norm_groups=16, .* model.unet.norm_groups=8"),
    ],
)
def test_a_start_whose_tensors_would_mean_something_else_is_refused(
    config: ModelConfig, tmp_path: Path, changed: dict[str, Any], said: str
) -> None:
    """Their names and shapes are the same."""
    save_model(ExtrapolationModel(config), tmp_path / "model")
    asked = changed | {"unet": replace(config.unet, **changed.get("unet", {}))}
    with pytest.raises(InputError, match=said) as raised:
        initial_model(replace(config, start=str(tmp_path / "model"), **asked))
    assert "\n" not in str(raised.value)
    assert "extrapolation_model.json" in str(raised.value)


def test_the_packaged_base_starts_no_model_that_predicts_otherwise() -> None:
    with pytest.raises(InputError, match=r"base.*prediction=sample.*or model\.start=null"):
        initial_model(ModelConfig(name="small", prediction="v_prediction", start="base"))


def test_a_start_without_geometry_is_told_it_without_effect(
    config: ModelConfig, tmp_path: Path, batch: PairBatch
) -> None:
    before = ExtrapolationModel(config).eval()
    torch.nn.init.normal_(before.unet.conv_out.weight, std=0.1)
    save_model(before, tmp_path / "model")
    told = initial_model(replace(config, geometry=True, start=str(tmp_path / "model"))).eval()
    steps = torch.tensor([3, 300, 900])
    noisy = torch.randn(before.condition(batch).base.shape)
    with torch.no_grad():
        made = [model(noisy, steps, model.condition(batch)) for model in (before, told)]
    torch.testing.assert_close(made[1], made[0])
    assert told.unet.conv_in.weight.shape[1] == before.unet.conv_in.weight.shape[1] + 2


@pytest.mark.parametrize("part", ["unet/diffusion_pytorch_model.safetensors", "image_encoder"])
def test_a_damaged_folder_names_the_file(config: ModelConfig, tmp_path: Path, part: str) -> None:
    save_model(ExtrapolationModel(config), tmp_path / "model")
    path = tmp_path / "model" / part
    if path.is_dir():
        (path / "model.safetensors").unlink()
    else:
        path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match=part):
        load_model(tmp_path / "model")


def test_a_full_disk_leaves_the_older_model(
    config: ModelConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    older = ExtrapolationModel(config)
    save_model(older, tmp_path / "model")
    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match="No space left on device"):
        save_model(ExtrapolationModel(config), tmp_path / "model")
    assert {path.name for path in tmp_path.iterdir()} - {".lock"} == {"model"}
    weight = load_model(tmp_path / "model").image_encoder[0].weight
    assert torch.equal(weight, older.image_encoder[0].weight)


def test_an_unknown_start_lists_what_there_is(config: ModelConfig) -> None:
    with pytest.raises(InputError, match=r"model\.start=nothing"):
        initial_model(replace(config, start="nothing"))


@pytest.mark.parametrize(
    "changed",
    [
        {"family": "unknown"},
        {"prediction": "epsilon"},  # at zero terminal SNR
        {"patch": 0},
        {"image_size": "large"},
        {"image_size": 33},
        {"references": None},
        {"unet": {"channels": []}},
        {"unet": {"widths": [16]}},
        {"unet": 3},
        {"vae": {"channels": []}},
        {"sampler": {"solver": "euler"}},
        {"sampler": {"steps": 0}},
        {"colour": "red"},
        {"name": "${oc.env:HOME}", "image_size": "${oc.env:HOME}"},
        {"unet": {"channels": [10**9, 10**9], "attention_levels": [False, True]}},
        {"unet": {"channels": [16] * 100, "attention_levels": [False] * 100}},
        {"unet": {"layers_per_block": 10**9}},
        {"octaves": 10**9},
        {"image_size": 2**20},
        {"image_size": 4096},
        {"warp_scale": 10**9},
        {"vae": {"channels": [10**9]}},
        {"clip": {"width": 10**9}},
        {"learning_rate": float("nan")},
    ],
)
def test_a_saved_configuration_that_means_no_model_is_refused(
    config: ModelConfig, tmp_path: Path, changed: dict[str, object]
) -> None:
    """Edited by hand, or of a version to come: one line that names the file."""
    save_model(ExtrapolationModel(config), tmp_path / "model")
    file = tmp_path / "model" / "extrapolation_model.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changed))
    with pytest.raises(InputError) as raised:
        load_model(tmp_path / "model")
    assert str(raised.value).startswith(f"{file}: ")
    assert "\n" not in str(raised.value)


def test_a_configuration_that_is_no_table_is_refused(config: ModelConfig, tmp_path: Path) -> None:
    save_model(ExtrapolationModel(config), tmp_path / "model")
    deep = "[" * 10**5
    for text in ("[1]", "3", "null", "{", '"a"', "", deep, f'{{"name": {deep}', "\udcff"):
        file = tmp_path / "model" / "extrapolation_model.json"
        file.write_text(text, errors="surrogateescape")
        with pytest.raises(InputError, match=str(file)) as raised:
            load_model(tmp_path / "model")
        assert "\n" not in str(raised.value)


def test_a_saved_model_may_be_read_as_the_umask_says(
    config: ModelConfig, tmp_path: Path, umask: Callable[[int], int]
) -> None:
    umask(0o022)
    save_model(ExtrapolationModel(config), tmp_path / "model")
    files = [path for path in (tmp_path / "model").rglob("*") if path.is_file()]
    assert len([path for path in files if path.suffix == ".safetensors"]) == 3
    assert {stat.S_IMODE(path.stat().st_mode) for path in files} == {0o644}


def test_a_model_without_permission_is_not_called_damaged(
    config: ModelConfig, tmp_path: Path, closed: Callable[[Path], AbstractContextManager[None]]
) -> None:
    save_model(ExtrapolationModel(config), tmp_path / "model")
    for name in ("unet/diffusion_pytorch_model.safetensors", "extrapolation_model.json"):
        with closed(tmp_path / "model" / name), pytest.raises(InputError, match="Permission"):
            load_model(tmp_path / "model")
