"""Preparations that share frames and pairs: none changes another's or redoes what is there."""

from dataclasses import replace
from pathlib import Path

import pytest
from captures import write_capture
from orbits import capture, even, ring

from data_prep.category_pairs import prepare_category
from data_prep.preparation import prepare
from extrap_train.config import (
    Co3dConfig,
    DatasetDepthConfig,
    FlowMatcherConfig,
    LoftrMatcherConfig,
    MonocularConfig,
    PrepConfig,
    SyntheticConfig,
    resolve_paths,
)
from extrap_train.data.frame_files import frames_folder, pairs_folder
from extrap_train.data.prepared import PreparedData
from extrap_train.data.sequences import FrameSequence

OPTIONS = PrepConfig(image_size=16)
HELD_OUT = [4, 9, 14, 19]


def run(root: Path, name: str, sequences: list[FrameSequence], options: PrepConfig) -> PreparedData:
    return prepare(
        sequences,
        DatasetDepthConfig(),
        options,
        test_names=1,
        folder=root / name,
        frames=root / "frames",
        pairs=root / "pairs",
        progress=False,
    )


def times(*folders: Path) -> dict[Path, int]:
    """When the files below folders were written; locks are none."""
    files = (file for folder in folders for file in folder.rglob("*") if file.is_file())
    return {file: file.stat().st_mtime_ns for file in files if file.suffix != ".lock"}


def test_a_lone_sequences_held_out_frames_stay_hidden_whoever_else_needs_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sequences = [
        capture(ring(even(24)), name, viewpoint_quality=quality)
        for name, quality in (("good", 0.5), ("poor", -0.5))
    ]
    strict = run(tmp_path, "strict", sequences, OPTIONS)
    assert strict.roles == {"cup/good": "train and test"}
    loose = run(tmp_path, "loose", sequences, replace(OPTIONS, min_viewpoint_quality=-1.0))
    assert sorted(loose.roles.values()) == ["test", "train"]
    assert loose.depths("cup/good", HELD_OUT).all()
    again = run(tmp_path, "strict", sequences, OPTIONS)
    assert f"{tmp_path / 'strict'}: prepared already" in capsys.readouterr().out
    for data in (strict, again):
        assert not data.depths("cup/good", HELD_OUT).any()


@pytest.mark.parametrize("part", ["frames.npy", "frames.parquet", "flows.npy"])
@pytest.mark.parametrize("content", [None, b"", b"half of it"])
def test_damage_is_noticed_and_mended_by_the_same_command(
    part: str, content: bytes | None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sequences = [capture(ring(even(9)), name) for name in ("a", "b", "c")]
    options = replace(OPTIONS, max_gap_deg=60.0)
    data = run(tmp_path, "cup", sequences, options)
    folder = frames_folder(tmp_path / "frames", "cup/b")
    if part == "flows.npy":
        folder = pairs_folder(tmp_path / "pairs", "cup/b", data.roles["cup/b"])
    whole, before = (folder / part).read_bytes(), times(tmp_path / "frames", tmp_path / "pairs")
    if content is None:
        (folder / part).unlink()
    else:
        (folder / part).write_bytes(content)
    run(tmp_path, "cup", sequences, options).images("cup/b", range(9))
    assert "frames or pairs of 1 sequences (first: cup/b) are damaged" in caplog.text
    assert (folder / part).read_bytes() == whole
    after = times(tmp_path / "frames", tmp_path / "pairs")
    assert {file.parent for file in before if after[file] != before[file]} == {folder}


def test_a_damaged_manifest_is_made_anew(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    sequences = [capture(ring(even(24)), name) for name in ("a", "b")]
    run(tmp_path, "cup", sequences, OPTIONS)
    manifest = tmp_path / "cup" / "preparation.json"
    whole = manifest.read_bytes()
    manifest.write_bytes(whole[:100])
    run(tmp_path, "cup", sequences, OPTIONS)
    assert "is damaged" in caplog.text
    assert manifest.read_bytes() == whole


def test_one_data_set_has_one_preparation_however_its_path_is_spelt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_capture(tmp_path / "co3d", ("one", "two"), 12)
    (tmp_path / "link").symlink_to("co3d")
    monkeypatch.chdir(tmp_path)
    for root in ("co3d", "link", str(tmp_path / "co3d")):
        prepare_category(
            "cup",
            Co3dConfig(root=root, test_sequences=1),
            DatasetDepthConfig(),
            PrepConfig(image_size=16, max_uses=2, max_gap_deg=40.0, correct=False),
            output=tmp_path / "outputs",
            workers=1,
            matcher=FlowMatcherConfig(),
        )
    assert capsys.readouterr().out.count("prepared already") == 2
    assert len(list((tmp_path / "outputs" / "data").glob("cup-*"))) == 1


def test_weights_are_the_same_however_their_path_is_spelt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "model").mkdir()
    monkeypatch.chdir(tmp_path)
    spelt, whole = (
        MonocularConfig(
            model=str(folder / "model"),
            matcher=LoftrMatcherConfig(checkpoint=str(folder / "loftr.ckpt")),
        )
        for folder in (Path(), tmp_path)
    )
    assert resolve_paths(spelt) == whole == resolve_paths(whole)
    named = MonocularConfig(matcher=FlowMatcherConfig())
    assert resolve_paths(named) == named
    assert resolve_paths(SyntheticConfig()) == SyntheticConfig()


def test_a_changed_option_redoes_only_what_depends_on_it(tmp_path: Path) -> None:
    names = ("one", "two", "three", "four")
    write_capture(tmp_path / "co3d", names, 10)
    output = tmp_path / "outputs"

    def prepared(tests: int, **options: object) -> PreparedData:
        return prepare_category(
            "cup",
            Co3dConfig(root=str(tmp_path / "co3d"), test_sequences=tests),
            DatasetDepthConfig(),
            PrepConfig(image_size=16, max_uses=2, max_gap_deg=40.0, **options),
            output=output,
            workers=1,
            matcher=FlowMatcherConfig(),
        )

    first = prepared(1, correct=True)
    frames, pairs = times(output / "frames"), times(output / "pairs")
    second = prepared(2, correct=True)
    assert sorted(first.roles.values()).count("test") == 1
    assert sorted(second.roles.values()).count("test") == 2
    (changed,) = (name for name in first.roles if first.roles[name] != second.roles[name])
    new = times(output / "pairs").keys() - pairs.keys()
    assert {file.parent.name for file in new} == {changed.removeprefix("cup/")}
    prepared(1, correct=True, min_viewpoint_quality=-1.0)
    prepared(1, correct=None)
    assert times(output / "pairs").keys() == pairs.keys() | new
    prepared(1, correct=False)
    assert times(output / "frames") == frames
    assert times(output / "pairs").items() >= pairs.items()
