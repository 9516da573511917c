"""Four bits a weight: how near they come, that such a folder loads, and what is refused."""

import json
import shutil
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from extrap_train.config import ModelConfig, UNetConfig
from extrap_train.diffusion import model_files
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import (
    initial_model,
    load_model,
    save_compact,
    save_model,
)
from extrap_train.diffusion.packaged import dequantised, quantised
from extrap_train.errors import InputError


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny base, and a model that was trained from it and packed."""
    folder = tmp_path_factory.mktemp("saved")
    unet = UNetConfig(channels=[16, 32], attention_levels=[False, True], heads=2, token_width=16)
    torch.manual_seed(0)
    model = ExtrapolationModel(ModelConfig(name="tiny", image_size=32, octaves=2, unet=unet))
    save_model(model, folder / "base", torch.float16)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_files, "packaged_weights", lambda name, option="": folder / name)
        save_compact(_trained(folder / "base"), folder / "packed")
    return folder


@pytest.fixture
def base(saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A tiny packaged model, and a package that holds nothing else."""
    shutil.copytree(saved / "base", tmp_path / "base")

    def packaged(name: str, option: str = "") -> Path:
        assert name == "base"
        return tmp_path / name

    monkeypatch.setattr(model_files, "packaged_weights", packaged)
    return tmp_path / "base"


@pytest.fixture
def packed(base: Path, saved: Path, tmp_path: Path) -> Path:
    """A model that was trained from the base, as its difference to that."""
    return Path(shutil.copytree(saved / "packed", tmp_path / "packed"))


def _trained(base: Path, **changes: object) -> ExtrapolationModel:
    """Moved away from the base as training moves: every weight by about as much."""
    start = load_model(base).config
    model = initial_model(replace(start, start="base", **changes))  # type: ignore[arg-type]
    with torch.no_grad():
        for value in model.parameters():
            value += 0.02 * torch.randn_like(value)
    return model


@pytest.mark.parametrize("count", [1, 2, 9, 64])
def test_values_on_the_levels_come_back_exactly(count: int) -> None:
    codes = torch.randint(-7, 8, (5, count))
    codes[:, 0] = 7
    rows = codes * torch.tensor([1.0, 0.5, 0.25, 2.0, 0.0])[:, None]
    packed, step = quantised(rows)
    assert packed.shape == (5, (count + 1) // 2)
    assert torch.equal(dequantised(packed, step, count), rows)


def test_normal_differences_lose_little_of_their_energy() -> None:
    """15 levels leave about 1.2 % of a normal variable's energy (Max 1960: 16 leave 1.15 %)."""
    torch.manual_seed(0)
    rows = torch.randn(16, 4000) * torch.logspace(-5, 0, 16)[:, None]
    error = dequantised(*quantised(rows), 4000) - rows
    assert float((error.square().sum(1) / rows.square().sum(1)).max()) < 0.02


def test_a_packed_model_comes_back_near_and_small(base: Path, tmp_path: Path) -> None:
    model = _trained(base)
    save_compact(model, tmp_path / "packed")
    loaded = load_model(tmp_path / "packed")
    assert loaded.config == model.config
    before = load_model(base).state_dict()
    for name, value in model.state_dict().items():
        moved = (value - before[name]).norm()
        assert (loaded.state_dict()[name] - value).norm() < 0.15 * moved, name
    size = (tmp_path / "packed" / "difference.safetensors").stat().st_size
    assert size < 0.5 * (base / "unet" / "diffusion_pytorch_model.safetensors").stat().st_size
    again = load_model(tmp_path / "packed").state_dict()
    assert all(torch.equal(again[name], x) for name, x in loaded.state_dict().items())


def test_another_family_keeps_its_own_first_layer_whole(base: Path, tmp_path: Path) -> None:
    model = _trained(base, family="zeronvs", residual=False)
    save_compact(model, tmp_path / "packed")
    loaded = load_model(tmp_path / "packed")
    torch.testing.assert_close(
        loaded.unet.conv_in.weight, model.unet.conv_in.weight, atol=1e-3, rtol=1e-3
    )


def test_training_starts_from_a_packed_model(packed: Path) -> None:
    loaded = load_model(packed)
    started = initial_model(replace(loaded.config, start=str(packed)))
    assert torch.equal(started.unet.conv_out.weight, loaded.unet.conv_out.weight)


def test_a_difference_to_another_base_is_refused(base: Path, packed: Path) -> None:
    save_model(_trained(base), base, torch.float16)
    with pytest.raises(InputError, match="difference to another base"):
        load_model(packed)


def test_a_damaged_or_shortened_file_is_refused(packed: Path) -> None:
    path = packed / "difference.safetensors"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="cut off, damaged"):
        load_model(packed)
    middle = len(whole) * 2 // 3
    path.write_bytes(whole[:middle] + bytes(8) + whole[middle + 8 :])
    with pytest.raises(InputError, match="is damaged"):
        load_model(packed)
    path.write_bytes(whole)
    about = json.loads(whole[8 : 8 + int.from_bytes(whole[:8], "little")])["__metadata__"]
    tensors = load_file(path)
    del tensors["unet.conv_out.weight:bits"]
    save_file(tensors, path, about)
    with pytest.raises(InputError, match=r"1 missing \(conv_out\.weight\)"):
        load_model(packed)


_NAME = "unet.conv_out.weight"


def _deflated(count: int) -> torch.Tensor:
    return torch.frombuffer(bytearray(zlib.compress(bytes(count), 9)), dtype=torch.uint8)


def _sizes(base: Path) -> tuple[int, int]:
    weight = load_file(base / "unet" / "diffusion_pytorch_model.safetensors")["conv_out.weight"]
    return len(weight), -(-weight[0].numel() // 2)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rows, n: {":bits": _deflated(rows * n + 1)}, "bits are not the"),
        (lambda rows, n: {":bits": _deflated(rows * n - 1)}, "bits are not the"),
        (lambda rows, n: {":bits": _deflated(rows * n * 2)}, "bits are not the"),
        (lambda rows, n: {":bits": _deflated(200_000_000)}, "bits are not the"),
        (lambda rows, n: {":bits": _deflated(rows * n)[:-3].clone()}, "bits are not the"),
        (lambda rows, n: {":bits": torch.cat([_deflated(rows * n)] * 2)}, "bits are not the"),
        (lambda rows, n: {":bits": _deflated(rows * n).float()}, "not bytes"),
        (lambda rows, n: {":scale": None}, "no scale a channel"),
        (lambda rows, n: {":scale": torch.ones(rows + 1)}, "no scale a channel"),
        (lambda rows, n: {":scale": torch.ones(rows, dtype=torch.int32)}, "no scale a channel"),
    ],
)
def test_what_is_no_difference_to_the_base_is_refused(
    base: Path, packed: Path, change: Callable, said: str
) -> None:
    _rewrite(packed / "difference.safetensors", _NAME, change(*_sizes(base)))
    tracemalloc.start()
    with pytest.raises(InputError, match=said) as raised:
        load_model(packed)
    assert tracemalloc.get_traced_memory()[1] < 50e6, "bytes that the shape has no place for"
    tracemalloc.stop()
    assert "\n" not in str(raised.value)


def test_a_difference_without_the_first_layer_is_refused(packed: Path) -> None:
    file = packed / "difference.safetensors"
    _rewrite(file, "unet.conv_in.weight", {":bits": None, ":scale": None})
    with pytest.raises(InputError, match="no convolution conv_in"):
        load_model(packed)


def _rewrite(file: Path, name: str, changed: dict[str, torch.Tensor | None]) -> None:
    whole = file.read_bytes()
    about = json.loads(whole[8 : 8 + int.from_bytes(whole[:8], "little")])["__metadata__"]
    tensors = load_file(file)
    for end, value in changed.items():
        del tensors[name + end]
        if value is not None:
            tensors[name + end] = value
    save_file(tensors, file, about)
