"""The package brings a model for every row of the comparison, and stays small."""

from pathlib import Path

import pytest

from extrap_train.config import MODEL_CONFIG, packaged_names
from extrap_train.diffusion.model_files import load_model
from extrap_train.diffusion.packaged import packaged_name, packaged_weights
from extrap_train.errors import InputError

_CATEGORIES = ("apple", "book", "chair", "cup", "hydrant", "teddybear")
_COMPARED = ["base", "megascenes", *(f"ours-{category}" for category in _CATEGORIES), "zeronvs"]


def test_every_compared_model_is_there() -> None:
    assert packaged_names() == sorted(_COMPARED)
    assert packaged_name("ours", "cup") == "ours-cup"
    assert packaged_name("ours", "all") in packaged_names()
    assert packaged_name("zeronvs", "cup") == "zeronvs"


def test_all_of_them_together_are_at_most_60_megabytes() -> None:
    files = [path for name in packaged_names() for path in packaged_weights(name).rglob("*")]
    assert sum(path.stat().st_size for path in files if path.is_file()) <= 60e6


@pytest.mark.parametrize("name", _COMPARED)
def test_each_is_a_model_of_its_family(name: str) -> None:
    model = load_model(packaged_weights(name))
    assert model.config.family == (name if name in ("zeronvs", "megascenes") else "ours")
    assert model.config.image_size == 64


def test_an_unknown_name_lists_the_known() -> None:
    with pytest.raises(InputError, match=r"=cup is neither .*: base, megascenes, ours-ap"):
        packaged_weights("cup")


def test_a_runs_folder_is_told_to_be_named_with_its_model(tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / MODEL_CONFIG).write_text("{}")
    with pytest.raises(InputError, match=rf"weights={tmp_path}: .*{tmp_path / 'model'}"):
        packaged_weights(str(tmp_path), "weights")
