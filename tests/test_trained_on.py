"""A run goes on with the data that it was begun with, or says why it cannot."""

from dataclasses import replace
from pathlib import Path

import pytest
from orbits import capture, even, ring
from prepared import prepared_captures

from extrap_train.config import (
    CategoryConfig,
    Co3dConfig,
    DatasetDepthConfig,
    FlowMatcherConfig,
    ModelConfig,
    TrainConfig,
)
from extrap_train.data.sequences import FrameSequence
from extrap_train.runs import run_manifest
from extrap_train.store.manifest import Manifest

_CONFIG = TrainConfig(
    category=CategoryConfig("cup", ["cup"]),
    data=Co3dConfig(root="/data/co3d"),
    depth=DatasetDepthConfig(),
    matcher=FlowMatcherConfig(),
    model=ModelConfig(name="small"),
)


def manifest(folder: Path, sequences: list[FrameSequence], test_names: set[str]) -> Manifest:
    return run_manifest(_CONFIG, [prepared_captures(folder, sequences, test_names)])


@pytest.fixture
def sequences(tmp_path: Path) -> list[FrameSequence]:
    """Each of whose frames has a file, of which only the stamp is looked at."""
    made = []
    for index in range(4):
        one = capture(ring(even(24)), f"{index:04d}")
        file = tmp_path / f"{one.name}.jpg"
        file.write_bytes(b"photograph")
        made.append(replace(one, frames=tuple(replace(f, files=(file,)) for f in one.frames)))
    return made


@pytest.fixture
def begun(tmp_path: Path, sequences: list[FrameSequence]) -> Manifest:
    return manifest(tmp_path / "cup", sequences, {"0000"})


def test_a_run_records_what_it_is_trained_on(begun: Manifest) -> None:
    cup = begun.split["cup"]
    assert (cup.source, cup.test, cup.train) == ("co3d", ("0000",), ("0001", "0002", "0003"))


def test_the_same_data_go_on_wherever_they_lie(
    begun: Manifest, sequences: list[FrameSequence], tmp_path: Path
) -> None:
    (tmp_path / "0002.jpg").touch()  # a copy has times of its own
    assert manifest(tmp_path / "moved" / "cup", sequences, {"0000"}).differences(begun) == []


def test_changed_photographs_are_a_difference(
    begun: Manifest, sequences: list[FrameSequence], tmp_path: Path
) -> None:
    (tmp_path / "0002.jpg").write_bytes(b"another photograph")
    (found,) = manifest(tmp_path / "cup", sequences, {"0000"}).differences(begun)
    assert "data of cup" in found


def test_another_split_is_a_difference(
    begun: Manifest, sequences: list[FrameSequence], tmp_path: Path
) -> None:
    """Else what is tested on would be what was trained on."""
    found = manifest(tmp_path / "cup", sequences, {"0001"}).differences(begun)
    assert any("split of cup" in text and "2 captures" in text for text in found)


@pytest.mark.parametrize("is_folder", [True, False])
def test_other_weights_to_start_from_are_a_difference(
    begun: Manifest, tmp_path: Path, is_folder: bool
) -> None:
    start = tmp_path / "start"
    weights = start / "unet" / "weights.bin" if is_folder else start
    weights.parent.mkdir(exist_ok=True, parents=True)
    weights.write_bytes(b"one")
    config = replace(_CONFIG, model=replace(_CONFIG.model, start=str(start)))
    first = run_manifest(replace(config, category=CategoryConfig("cup", [])), [])
    weights.write_bytes(b"two")
    second = run_manifest(replace(config, category=CategoryConfig("cup", [])), [])
    (found,) = second.differences(first)
    assert "model.start" in found
