"""A published checkpoint serves the tasks about a scene, by `weights=` and `model=` alone."""

import json
import sys
from pathlib import Path

import pytest
import torch
from PIL import Image
from published_networks import TINY_MODEL, Reference, tiny_config
from safetensors.torch import load_file

from extrap_train import open_generator
from extrap_train.__main__ import main
from extrap_train.diffusion.model_files import initial_model, save_model
from extrap_train.errors import InputError

_SCENE = ["category=hydrant", "scene=synthetic:hydrant/0000", "data.frames=6", "data.image_size=32"]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def run(family: str, weights: Path, *arguments: str) -> None:
        options = [
            *_SCENE,
            *TINY_MODEL,
            f"model={family}",
            f"weights={weights}",
            f"output={tmp_path}",
        ]
        quick = ["trainer.precision=32-true", "sampler.steps=1", "sampler.guidance=1"]
        monkeypatch.setattr(sys, "argv", ["extrap_train", *options, *quick, *arguments])
        main()

    return run


def test_it_generates(command, reference: Reference, checkpoint: Path, tmp_path: Path) -> None:
    command(reference.family, checkpoint, "task=view", "inputs=3", "pose=frame000003")
    folder = tmp_path / "view" / "hydrant-0000"
    assert Image.open(folder / "views" / "frame000003.png").size == (128, 128)


def test_a_plain_diffusers_folder_generates(
    command, references: dict[str, Reference], tmp_path: Path
) -> None:
    """As diffusers itself leaves it: without our configuration beside it."""
    torch.save(references["zeronvs"].state, tmp_path / "zeronvs.ckpt")
    model = initial_model(tiny_config("zeronvs", start=str(tmp_path / "zeronvs.ckpt")))
    save_model(model, tmp_path / "model")
    (tmp_path / "model" / "extrapolation_model.json").unlink()
    command("zeronvs", tmp_path / "model", "task=view", "inputs=3", "pose=frame000003")
    assert (tmp_path / "view" / "hydrant-0000" / "sheet.png").is_file()


@pytest.mark.slow
def test_it_is_adapted(command, references: dict[str, Reference], tmp_path: Path) -> None:
    path = tmp_path / "zeronvs.ckpt"
    torch.save({"state_dict": references["zeronvs"].state}, path)
    options = ["lora.steps=1", "lora.batch_size=1", "lora.validate_every=1", "inputs=2"]
    command("zeronvs", path, "task=scene", "validation.examples=1", *options)
    folder = tmp_path / "scene" / "hydrant-0000"
    assert json.loads((folder / "summary.json").read_text())["adaptation"]["steps"] == 1
    assert load_file(folder / "adapter" / "adapter_model.safetensors")


def test_of_another_size_than_the_model_it_says_which_option(
    command, references: dict[str, Reference], tmp_path: Path
) -> None:
    path = tmp_path / "zeronvs.ckpt"
    torch.save({"state_dict": references["zeronvs"].state}, path)
    with pytest.raises(SystemExit) as stopped:
        command("zeronvs", path, "task=view", "inputs=3", "orbit=90", "model.clip.layers=3")
    message = str(stopped.value)
    assert f"error: {path}: lacks" in message
    assert "give weights=FILE" in message


@pytest.mark.parametrize(
    ("found", "asked"),
    [("zeronvs", "ours"), ("zeronvs", "megascenes"), ("megascenes", "ours")],
)
def test_another_family_is_a_start_and_generates_nothing(
    command, references: dict[str, Reference], tmp_path: Path, found: str, asked: str
) -> None:
    """Widened, it would generate without a word as though there were no warp."""
    path = tmp_path / f"{found}.ckpt"
    torch.save({"state_dict": references[found].state}, path)
    with pytest.raises(SystemExit) as stopped:
        command(asked, path, "task=view", "inputs=3", "pose=frame000003")
    message = str(stopped.value)
    assert "\n" not in message
    assert f"error: {path}: is of the family {found}" in message
    assert f"model={asked} is of {asked} and was never trained: give model={found}" in message
    assert ("model.start=FILE" in message) == (found == "zeronvs")
    with pytest.raises(InputError, match=f"is of the family {found}"):
        open_generator(str(path), config=tiny_config(asked))


@pytest.mark.parametrize("asked", ["ours", "megascenes"])
def test_another_family_is_still_what_training_starts_from(
    references: dict[str, Reference], tmp_path: Path, asked: str
) -> None:
    path = tmp_path / "zeronvs.ckpt"
    torch.save({"state_dict": references["zeronvs"].state}, path)
    weight = initial_model(tiny_config(asked, start=str(path))).unet.conv_in.weight
    assert weight[:, :8].any()
    assert not weight[:, 8:].any()
