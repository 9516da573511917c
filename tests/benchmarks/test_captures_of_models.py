"""A model is tested on what its own run has held out, never on what it was trained on."""

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.protocol.captures import Trained, open_captures, trained_models
from data_prep.split import split_sequences
from extrap_train.config import (
    MODEL_CONFIG,
    CapturesConfig,
    MethodConfig,
    ModelConfig,
    SyntheticConfig,
)
from extrap_train.errors import InputError
from extrap_train.store.manifest import MANIFEST, Manifest, Split
from extrap_train.store.records import write_record
from tests.captures import view_at, write_capture
from tests.posed_folders import write_transforms

_NAMES = ("a", "b", "c", "d", "e", "f")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("co3d")
    write_capture(made, _NAMES, frames=12, size=16)
    return made


def _write_run(folder: Path, split: Split, start: str | None = None) -> str:
    """What a run of cups leaves of its model and what it was trained on; the model's folder."""
    (model := folder / "cup-run" / "model").mkdir(parents=True)
    write_record(folder / "cup-run" / MANIFEST, Manifest.of({}, {}, {"cup": split}))
    write_record(model / MODEL_CONFIG, ModelConfig(start=start))
    return str(model)


def _models_of(weights: str | None) -> Trained:
    method = MethodConfig("mine", factory="a.B", options={"weights": weights})
    return trained_models([method, MethodConfig("other", factory="a.C")], ["cup"])


def _models(folder: Path, test: tuple[str, ...]) -> Trained:
    """The models of a method whose weights come from a run that held out these captures."""
    train = tuple(name for name in _NAMES if name not in test)
    _write_run(folder, Split("co3d", train, test))
    return _models_of(str(folder / "{category}-run" / "model"))


def _write_folders(root: Path) -> Path:
    for name in _NAMES[:3]:
        write_transforms(root / "cup" / name, [view_at(30 * i, 16) for i in range(12)])
    return root


def test_captures_of_ones_own_are_those_that_the_run_has_held_out(tmp_path: Path) -> None:
    own = _write_folders(tmp_path / "own")
    weights = _write_run(tmp_path / "runs", Split("folders", ("a", "b"), ("c",)))
    config = CapturesConfig(source="folders", root=str(own))
    found = open_captures(config, ["cup"], _models_of(weights))
    assert [capture.sequence.name for capture in found] == ["c"]
    with pytest.raises(InputError, match=r"captures\.categories=\[\]"):
        open_captures(config, [], _models_of(weights))
    config = CapturesConfig(source="scenes", scenes=[str(own / "cup" / "a")])
    with pytest.raises(InputError, match=r"options\.mine\.weights.*trained on .* cup/a;"):
        open_captures(config, ["cup"], _models_of(weights))


def _captures(root: Path, models: Trained, count: int = 2) -> list[str]:
    config = CapturesConfig(source="co3d", root=str(root), sequences=count)
    return [capture.sequence.name for capture in open_captures(config, ["cup"], models)]


def test_captures_are_those_that_the_run_has_held_out(root: Path, tmp_path: Path) -> None:
    usual = {name.split("/")[1] for name in split_sequences([f"cup/{n}" for n in _NAMES], 2).test}
    others = tuple(name for name in _NAMES if name not in usual)[:2]
    assert set(_captures(root, [])) == usual
    assert set(_captures(root, _models(tmp_path, others))) == set(others)


def test_no_more_are_taken_than_asked_for(root: Path, tmp_path: Path) -> None:
    assert len(_captures(root, _models(tmp_path, ("a", "b", "c")), count=1)) == 1


def test_two_runs_that_hold_out_nothing_in_common_are_refused(root: Path, tmp_path: Path) -> None:
    models = [*_models(tmp_path / "1", ("a", "b")), *_models(tmp_path / "2", ("c",))]
    with pytest.raises(
        InputError, match=r"cup: none of the 6 .*1/cup-run/model and .*2/cup-run/model"
    ):
        _captures(root, models)


def test_a_named_capture_that_was_trained_on_is_refused(root: Path, tmp_path: Path) -> None:
    models = _models(tmp_path, ("a",))
    config = CapturesConfig(source="scenes", scenes=[f"co3d:{root}/cup/a"])
    assert len(open_captures(config, ["cup"], models)) == 1
    config.scenes.append(f"co3d:{root}/cup/b")
    with pytest.raises(
        InputError, match=r"options\.mine\.weights.*cup-run/model was trained on .* cup/b;"
    ):
        open_captures(config, ["cup"], models)


def test_a_capture_that_the_weights_started_from_has_seen_is_refused(
    root: Path, tmp_path: Path
) -> None:
    start = _write_run(tmp_path / "start", Split("co3d", ("a", "c"), ("e",)))
    tuned = _write_run(tmp_path / "tuned", Split("co3d", ("d",), ("a", "b", "f")), start)
    models = _models_of(tuned)
    assert set(_captures(root, models, count=6)) == {"b", "f"}
    config = CapturesConfig(source="scenes", scenes=[f"co3d:{root}/cup/c"])
    with pytest.raises(InputError, match=r"start/cup-run/model was trained on the capture cup/c;"):
        open_captures(config, ["cup"], models)


def test_rendered_captures_that_a_run_was_trained_on_are_refused(tmp_path: Path) -> None:
    split = Split("synthetic", ("0001", "0002"), ("0000",), seed=7)
    models = _models_of(_write_run(tmp_path, split))

    def open_rendered(categories: list[str], sequences: int = 1, seed: int = 7) -> None:
        config = CapturesConfig(source="synthetic", sequences=sequences, seed=seed)
        open_captures(config, categories, models)

    open_rendered(["cup"])
    open_rendered(["cup"], sequences=2, seed=8)
    open_rendered(["book"], sequences=2)
    with pytest.raises(InputError, match=r"cup-run/model was trained on the capture cup/0001;"):
        open_rendered(["cup"], sequences=2)


def test_rendered_scenes_that_a_run_was_trained_on_are_refused(root: Path, tmp_path: Path) -> None:
    usual = SyntheticConfig().seed
    models = _models_of(_write_run(tmp_path, Split("synthetic", ("0001", "a"), ("0002",), usual)))
    config = CapturesConfig(source="scenes", scenes=["synthetic:cup/0002", f"co3d:{root}/cup/a"])
    assert len(open_captures(config, ["cup"], models)) == 2
    config.scenes.append("synthetic:cup/0001")
    with pytest.raises(InputError, match=r"cup-run/model was trained on the capture cup/0001;"):
        open_captures(config, ["cup"], models)


@pytest.mark.parametrize("weights", ["base", None])
def test_packaged_models_say_what_they_were_trained_on(weights: str | None) -> None:
    """A method that names no weights may use any of them."""
    first_seen = SyntheticConfig().test_sequences
    config = CapturesConfig(source="synthetic", sequences=first_seen)
    assert len(open_captures(config, ["cup"], _models_of(weights))) == first_seen
    with pytest.raises(InputError, match=rf"base was trained on .* cup/000{first_seen};"):
        open_captures(replace(config, sequences=first_seen + 1), ["cup"], _models_of(weights))
    open_captures(replace(config, sequences=first_seen + 1, seed=1), ["cup"], _models_of(weights))
    named = CapturesConfig(source="scenes", scenes=["synthetic:cup/0010"])
    with pytest.raises(InputError, match=r"captures\.scenes"):
        open_captures(named, ["cup"], _models_of(weights))


@pytest.mark.parametrize("start", [None, "base"])
def test_a_model_without_a_record_is_not_measured_on_what_is_usually_trained_on(
    tmp_path: Path, start: str | None
) -> None:
    """As one that was copied out of its run."""
    write_record(tmp_path / MODEL_CONFIG, ModelConfig(start=start))
    first_seen = SyntheticConfig().test_sequences
    models = _models_of(str(tmp_path))
    models = [used for used in models if used.method == "mine"]
    config = CapturesConfig(source="synthetic", sequences=first_seen)
    assert len(open_captures(config, ["cup"], models)) == first_seen
    with pytest.raises(InputError, match=rf"options\.mine\.weights: .* cup/000{first_seen};"):
        open_captures(replace(config, sequences=first_seen + 1), ["cup"], models)
    open_captures(replace(config, sequences=first_seen + 1, seed=1), ["cup"], models)


def test_a_method_that_names_no_weights_is_told_of_captures_alone() -> None:
    config = CapturesConfig(source="synthetic", sequences=SyntheticConfig().test_sequences + 1)
    with pytest.raises(InputError, match=r"captures\.sequences") as refused:
        open_captures(config, ["cup"], _models_of(None))
    assert ".weights" not in str(refused.value)
    assert "other weights" not in str(refused.value)
