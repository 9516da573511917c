"""The published layouts at a tiny size, filled by name, beside what the published code computed."""

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from published_networks import FAMILIES, Reference
from safetensors.torch import load_file
from torch import Tensor

Weights = Callable[[dict[str, list[int]]], dict[str, Tensor]]


@pytest.fixture(scope="session")
def seeded(shared: Path) -> Weights:
    """Fills a layout with weights drawn by name."""
    spec = importlib.util.spec_from_file_location("seeded", shared / "fixtures" / "seeded.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.weights


@pytest.fixture(scope="session")
def references(shared: Path, seeded: Weights) -> dict[str, Reference]:
    made = {}
    for family in FAMILIES:
        folder = shared / "fixtures" / f"{family}_tiny"
        layout = json.loads((folder / "layout.json").read_text())["keys"]
        expected = load_file(folder / "expected.safetensors")
        made[family] = Reference(family, seeded(layout), expected)
    return made


@pytest.fixture(scope="session", params=FAMILIES)
def reference(request: pytest.FixtureRequest, references: dict[str, Reference]) -> Reference:
    return references[request.param]


@pytest.fixture(scope="session")
def checkpoint(reference: Reference, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file that a user downloads: Lightning's `.ckpt`, or accelerate's folder."""
    parent = tmp_path_factory.mktemp(reference.family)
    if reference.family == "zeronvs":
        path = parent / "zeronvs.ckpt"
        torch.save({"state_dict": reference.state, "global_step": 7}, path)
        return path
    folder = parent / "iter_7"
    folder.mkdir()
    torch.save(reference.state, folder / "pytorch_model.bin")
    return folder
