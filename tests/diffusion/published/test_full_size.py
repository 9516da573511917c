"""The full-size configurations take the full-size layouts, tensor by tensor, without memory."""

import json
from pathlib import Path

import pytest
import torch
from published_networks import configured

from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import load_weights
from extrap_train.diffusion.published.recognise import recognise_config
from extrap_train.weight_files import WeightFile


def _layout(folder: Path, family: str) -> dict[str, list[int]]:
    def keys(name: str) -> dict[str, list[int]]:
        return json.loads((folder / f"{name}.json").read_text())["keys"]

    parts = [f"{family}_unet", "vae", "clip_image_encoder", "cc_projection"]
    names = keys("zeronvs_full") if family == "zeronvs" else {}
    for part in parts:
        names |= keys(part)
    return names


@pytest.mark.parametrize("model", ["zeronvs", "megascenes"])
def test_one_reference_is_loaded_where_one_is_told(model: str) -> None:
    assert configured(model).references == configured(model).num_condition_views == 1


@pytest.mark.parametrize(
    ("layout", "model", "denoiser_parameters"),
    [
        ("zeronvs", "zeronvs", 859_532_484),
        ("megascenes", "megascenes", 859_541_124),
        ("zeronvs", "ours", 859_532_484 + 320 * 9 * 37),
    ],
)
def test_the_published_layout_loads(
    shared: Path,
    monkeypatch: pytest.MonkeyPatch,
    layout: str,
    model: str,
    denoiser_parameters: int,
) -> None:
    """The tensors are never written to, so that they take no memory."""
    shapes = _layout(shared / "layouts", layout)
    state = {name: torch.empty(shape) for name, shape in shapes.items()}
    monkeypatch.setattr(WeightFile, "read", lambda *_: state)
    with torch.device("meta"):
        network = ExtrapolationModel(configured(model))
    load_weights(network, Path("weights.safetensors"))
    counted = {p: sum(x.numel() for x in n.parameters()) for p, n in network.parts().items()}
    assert counted["unet"] == denoiser_parameters
    assert counted["vae"] == 83_653_863
    assert counted["cc_projection"] == 605_184


@pytest.mark.parametrize("family", ["zeronvs", "megascenes"])
def test_the_published_layout_is_recognised(
    shared: Path, monkeypatch: pytest.MonkeyPatch, family: str
) -> None:
    """As the model that `model=FAMILY` describes, whose numbers stand in its file."""
    shapes = _layout(shared / "layouts", family)
    state = {name: torch.empty(shape) for name, shape in shapes.items()}
    monkeypatch.setattr(WeightFile, "read", lambda *_: state)
    assert recognise_config(Path("weights.ckpt"), "weights") == configured(family)
