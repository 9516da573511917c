"""A model is tested on what its own run has held out, never on what it was trained on."""

from pathlib import Path

import pytest

from benchmarks.protocol.captures import TrainedModel, open_captures, trained_models
from data_prep.split import split_sequences
from extrap_train.config import CapturesConfig, MethodConfig
from extrap_train.errors import InputError
from extrap_train.store.manifest import MANIFEST, Manifest, Split
from extrap_train.store.records import write_record
from tests.captures import write_capture

_NAMES = ("a", "b", "c", "d", "e", "f")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("co3d")
    write_capture(made, _NAMES, frames=12, size=16)
    return made


def _models(
    folder: Path, test: tuple[str, ...], source: str = "co3d", weights: str | None = None
) -> list[TrainedModel]:
    """Of a method with the weights of a run that has held out these captures."""
    train = tuple(name for name in _NAMES if name not in test)
    run = folder / "cup-run"
    run.mkdir(parents=True)
    write_record(run / MANIFEST, Manifest.of({}, {}, {"cup": Split(source, train, test)}))
    given = weights or str(folder / "{category}-run" / "model")
    method = MethodConfig("mine", factory="a.B", options={"weights": given})
    return trained_models([method, MethodConfig("other", factory="a.C")], ["cup"])


def _captures(root: Path, models: list[TrainedModel], count: int = 2) -> list[str]:
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
    with pytest.raises(InputError, match=r"cup: none of the 6 .*1/cup-run and .*2/cup-run"):
        _captures(root, models)


def test_a_named_capture_that_was_trained_on_is_refused(root: Path, tmp_path: Path) -> None:
    models = _models(tmp_path, ("a",))
    config = CapturesConfig(source="scenes", scenes=[f"co3d:{root}/cup/a"])
    assert len(open_captures(config, ["cup"], models)) == 1
    config.scenes.append(f"co3d:{root}/cup/b")
    with pytest.raises(InputError, match=r"options\.mine\.weights.*cup-run was trained on .* b;"):
        open_captures(config, ["cup"], models)


def test_runs_of_rendered_captures_say_nothing_of_photographs(tmp_path: Path) -> None:
    assert not _models(tmp_path, ("a",), source="synthetic")


def test_packaged_weights_say_nothing(tmp_path: Path) -> None:
    assert not _models(tmp_path, ("a",), weights="base")
