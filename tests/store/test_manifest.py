"""Two manifests differ in what a result follows from, and in nothing else."""

from dataclasses import replace
from pathlib import Path

import pytest

from extrap_train.store.manifest import MANIFEST, Conflict, Manifest, Split, claim
from extrap_train.store.records import read_record, write_record

_SPLIT = Split("synthetic", ("0002", "0003"), ("0000", "0001"), seed=0)
_MANIFEST = Manifest.of(
    {"depth.name": "stereo", "inputs": (1, 2), "seed": 0},
    {"photograph a.jpg": "aa", "weights": "bb"},
    {"hydrant": _SPLIT},
)


def test_it_comes_back_equal_from_its_file(tmp_path: Path) -> None:
    write_record(tmp_path / "manifest.json", _MANIFEST)
    assert read_record(tmp_path / "manifest.json", Manifest, "") == _MANIFEST


def test_versions_are_recorded_and_not_compared() -> None:
    assert _MANIFEST.packages["torch"]
    assert _MANIFEST.code
    other = replace(_MANIFEST, code="9", packages={})
    assert other.differences(_MANIFEST) == []


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"options": {**_MANIFEST.options, "seed": 1}}, ["seed", "0", "1"]),
        ({"options": {"seed": 0, "inputs": [1, 2]}}, ["depth.name", "stereo"]),
        ({"options": {**_MANIFEST.options, "new": 3}}, ["new", "3"]),
        ({"inputs": {**_MANIFEST.inputs, "weights": "cc"}}, ["weights"]),
        ({"inputs": {"weights": "bb"}}, ["photograph a.jpg"]),
        ({"inputs": {**_MANIFEST.inputs, "photograph b.jpg": "cc"}}, ["photograph b.jpg"]),
        ({"split": {"hydrant": replace(_SPLIT, test=("0000",))}}, ["hydrant"]),
        (
            {"split": {"hydrant": replace(_SPLIT, train=("0001",), test=("0002",))}},
            ["hydrant", "2 captures", "0001"],
        ),
        ({"split": {**_MANIFEST.split, "apple": _SPLIT}}, ["apple", "new"]),
        ({"split": {}}, ["hydrant"]),
    ],
)
def test_every_change_of_content_is_named(change: dict, named: list[str]) -> None:
    found = replace(_MANIFEST, **change).differences(_MANIFEST)
    assert len(found) == 1
    assert all(word in found[0] for word in named)


def test_many_differences_are_counted() -> None:
    other = replace(_MANIFEST, inputs={f"photograph {i}": "x" for i in range(40)})
    found = other.differences(_MANIFEST)
    assert len(found) < 10
    assert "36 more" in found[-1]


def test_a_result_that_failed_before_its_first_file_does_not_hinder_another(tmp_path: Path) -> None:
    folder, other = tmp_path / "result", replace(_MANIFEST, options={"depth.name": "dataset"})
    with claim(folder, _MANIFEST, resume=True) as result:
        result.begin()
    with claim(folder, other, resume=True) as result:
        assert not result.is_reused
        result.begin()
        (folder / "cloud.ply").touch()
    with pytest.raises(Conflict, match=r"depth\.name"), claim(folder, _MANIFEST, resume=True):
        pass
    assert {path.name for path in folder.iterdir()} == {MANIFEST, "cloud.ply"}
