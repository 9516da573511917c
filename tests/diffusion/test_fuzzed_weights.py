"""Hostile and damaged weights at every option that takes some: each is refused in one line or read,
nothing of it is run, and neither memory nor time runs away.

`python -m pytest -m slow tests/diffusion/test_fuzzed_weights.py` takes a few minutes.
"""

import json
import multiprocessing
import pickle
import resource
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hostile_weights import (
    Bomb,
    damaged,
    hostile_files,
    hostile_pickles,
    hostile_safetensors,
    hostile_settings,
)
from torch import nn
from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, DPTImageProcessor

from extrap_train.config import AlikedMatcherConfig, LoftrMatcherConfig, LoraConfig, ModelConfig
from extrap_train.depth.depth_anything import read_depth_anything
from extrap_train.depth.mast3r.network.mast3r_checkpoint import read_network
from extrap_train.diffusion.lora import AdapterOrigin, add_adapter, load_adapter, save_adapter
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import initial_model, load_model, save_model
from extrap_train.errors import InputError
from extrap_train.matching.aliked import read_aliked
from extrap_train.matching.loftr import read_loftr
from extrap_train.metrics import BACKBONES, lpips_distance, squeeze_lpips

pytestmark = pytest.mark.slow

_MAX_BYTES, _MAX_SECONDS = 4 * 2**30, 20.0


def _measured(read: Callable[[], Any], sender: Any) -> None:
    """In a process of its own: what became of one input, and what it took."""
    began = time.process_time()  # a busy machine is not the file's fault
    try:
        read()
        said = "read"
    except InputError as error:
        said = "refused" if "\n" not in str(error) else f"several lines: {error}"
    except BaseException as error:  # anything else would be a traceback
        said = f"{type(error).__name__}: {error}"[:300]
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    sender.send((said, time.process_time() - began, peak))


def _outcome(read: Callable[[], Any]) -> tuple[str, float, int]:
    """Forked, so that a file that ends or bloats its process tells so."""
    receiver, sender = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=_measured, args=(read, sender))
    process.start()
    sender.close()
    try:
        found = receiver.recv() if receiver.poll(10 * _MAX_SECONDS) else ("no end", 99.0, 0)
    except EOFError:
        found = "the process died", 0.0, 0
    if process.is_alive() and found[0] == "no end":
        process.kill()
    process.join()
    return found


@pytest.fixture(scope="module")
def state() -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(8, 8), nn.LayerNorm(8)).state_dict()


_READERS: dict[str, Callable[[Path], Any]] = {
    "model.start": lambda path: initial_model(ModelConfig(name="tiny", start=str(path))),
    "depth.checkpoint": lambda path: read_network(path),
    "matcher.checkpoint=loftr": lambda path: read_loftr(path, LoftrMatcherConfig(), "option"),
    "matcher.checkpoint=aliked": lambda path: read_aliked(path, AlikedMatcherConfig(), "option"),
    "validation.lpips_weights": lambda path: lpips_distance("squeeze", str(path), "option"),
}


def _require_sound(
    cases: Iterator[tuple[str, Callable[[], Any]]], target: Path, least: int
) -> None:
    count, wrong = 0, []
    for name, read in cases:
        said, seconds, peak = _outcome(read)
        count += 1
        if said not in ("read", "refused") or seconds > _MAX_SECONDS or peak > _MAX_BYTES:
            wrong.append(f"{name}: {said} after {seconds:.1f} s with {peak >> 20} MiB")
        if target.exists():
            wrong.append(f"{name}: was executed")
            target.unlink()
    assert not wrong, "\n".join(wrong)
    assert count >= least


@pytest.mark.parametrize("option", _READERS)
def test_hostile_files(option: str, state: dict[str, torch.Tensor], tmp_path: Path) -> None:
    def cases() -> Iterator[tuple[str, Callable[[], Any]]]:
        for name, suffix, content in hostile_files(state, tmp_path / "ran"):
            path = tmp_path / f"weights{suffix}"
            path.write_bytes(content)
            yield name, lambda path=path: _READERS[option](path)
            path.unlink()

    _require_sound(cases(), tmp_path / "ran", least=110)


def test_hostile_backbones_in_the_hub_cache(
    state: dict[str, torch.Tensor], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    file = tmp_path / "hub" / "checkpoints" / BACKBONES["squeeze"]
    file.parent.mkdir(parents=True)

    def cases() -> Iterator[tuple[str, Callable[[], Any]]]:
        for name, _, content in hostile_files(state, tmp_path / "ran"):
            file.write_bytes(content)
            yield name, lambda: squeeze_lpips(None)

    _require_sound(cases(), tmp_path / "ran", least=110)


def _tiny(config: ModelConfig) -> ExtrapolationModel:
    torch.manual_seed(0)
    return ExtrapolationModel(config).eval()


def _model_folder(config: ModelConfig, folder: Path) -> Callable[[], Any]:
    save_model(_tiny(config), folder)
    return lambda: load_model(folder)


def _adapter_folder(config: ModelConfig, folder: Path) -> Callable[[], Any]:
    model = _tiny(config)
    adapter = add_adapter(model, LoraConfig(rank=2), seed=0)
    origin = AdapterOrigin("/scene", {"a.jpg": "0" * 64}, "base")
    save_adapter(model, adapter, folder, origin)
    adapter.unload()
    return lambda: load_adapter(model, folder)


def _depth_anything_folder(_: ModelConfig, folder: Path) -> Callable[[], Any]:
    backbone = {
        "model_type": "dinov2", "hidden_size": 16, "num_hidden_layers": 4,
        "num_attention_heads": 2, "image_size": 28, "patch_size": 14,
        "out_indices": [1, 2, 3, 4], "reshape_hidden_states": False, "apply_layernorm": True,
    }  # fmt: skip
    config = DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, neck_hidden_sizes=[4, 4, 8, 8],
        fusion_hidden_size=8, head_hidden_size=4,
    )  # fmt: skip
    DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    DPTImageProcessor(size={"height": 28, "width": 28}).save_pretrained(folder)
    return lambda: read_depth_anything(str(folder), torch.device("cpu"))


@pytest.mark.parametrize(
    ("make", "tables", "weights"),
    [
        (
            _model_folder,
            ["extrapolation_model.json"],
            "unet/diffusion_pytorch_model.safetensors",
        ),
        (_adapter_folder, ["adapter_config.json", "base.json"], "adapter_model.safetensors"),
        (
            _depth_anything_folder,
            ["config.json", "preprocessor_config.json"],
            "model.safetensors",
        ),
    ],
    ids=["weights", "adapter", "depth.model"],
)
def test_hostile_folders(
    make: Callable[[ModelConfig, Path], Callable[[], Any]],
    tables: list[str],
    weights: str,
    config: ModelConfig,
    state: dict[str, torch.Tensor],
    tmp_path: Path,
) -> None:
    folder = tmp_path / "folder"
    read = make(replace(config), folder)
    assert _outcome(read)[0] == "read"

    def cases() -> Iterator[tuple[str, Callable[[], Any]]]:
        for table in tables:
            whole = (folder / table).read_bytes()
            for name, content in hostile_settings(json.loads(whole)):
                (folder / table).write_bytes(content)
                yield f"{table}: {name}", read
            (folder / table).write_bytes(whole)
        whole = (folder / weights).read_bytes()
        for name, content in [*hostile_safetensors(state), *hostile_pickles(tmp_path / "ran")]:
            (folder / weights).write_bytes(content)
            yield f"{weights}: {name}", read
        for name, content in damaged("its own", whole):
            (folder / weights).write_bytes(content)
            yield f"{weights}: {name}", read
        (folder / weights).unlink()
        (folder / weights).with_name("pytorch_model.bin").write_bytes(pickle.dumps(Bomb(folder)))
        yield "a pickle in its place", read
        shutil.rmtree(folder)
        yield "gone", read

    _require_sound(cases(), tmp_path / "ran", least=110)
