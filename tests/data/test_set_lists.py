"""CO3D's own division into training and testing."""

import json
from pathlib import Path

import pytest
from captures import write_capture

from extrap_train.data.co3d.annotations import read_sequence_split
from extrap_train.errors import InputError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_capture(tmp_path)
    return tmp_path


def _write(root: Path, content: object) -> Path:
    file = root / "cup" / "set_lists" / "set_lists_fewview_dev.json"
    file.write_text(json.dumps(content))
    return file


def test_our_own_lists_are_read(root: Path) -> None:
    assert read_sequence_split(root, "cup", "manyview_dev_0") == ({"one"}, {"two"})


def test_a_sequence_is_for_training_or_for_testing(root: Path) -> None:
    frames = {name: [name, 1, f"cup/{name}/1.jpg"] for name in "abcd"}
    content = {"train": [frames["a"], frames["b"]], "val": [frames["d"]], "test": [frames["c"]]}
    _write(root, content)
    assert read_sequence_split(root, "cup", "fewview_dev") == ({"a", "b"}, {"c"})


@pytest.mark.parametrize(
    ("train", "test", "said"),
    [
        (["a", "b"], ["b"], r"divides the frames of a sequence \(b\), not the sequences; give"),
        (["a"], [], "its list 'test' is empty; give"),
        ([], ["a"], "its list 'train' is empty; give"),
    ],
)
def test_a_list_that_holds_no_sequence_out_is_refused(
    root: Path, train: list[str], test: list[str], said: str
) -> None:
    subsets = {"train": train, "val": [], "test": test}
    file = _write(root, {k: [[name, 1, "x.jpg"] for name in v] for k, v in subsets.items()})
    with pytest.raises(InputError, match=f"{file.name}: {said}"):
        read_sequence_split(root, "cup", "fewview_dev")


def test_an_unknown_list_names_those_that_are_there(root: Path) -> None:
    with pytest.raises(InputError, match=r"set_lists_dev\.json: no such .* known: manyview_dev_0"):
        read_sequence_split(root, "cup", "dev")


@pytest.mark.parametrize("content", [[], {"train": 3}, {"train": [["one", 1]]}])
def test_set_lists_of_the_wrong_shape(root: Path, content: object) -> None:
    file = _write(root, content)
    with pytest.raises(InputError, match=file.name):
        read_sequence_split(root, "cup", "fewview_dev")
