"""A model is never measured on what its start, or that one's start, was trained on."""

import json
from pathlib import Path

import pytest

from extrap_train.config import (
    MODEL_CONFIG,
    CategoryConfig,
    DatasetDepthConfig,
    FlowMatcherConfig,
    ModelConfig,
    SyntheticConfig,
    TrainConfig,
    packaged_names,
)
from extrap_train.diffusion.leakage import TrainedCaptures
from extrap_train.diffusion.packaged import packaged_weights
from extrap_train.errors import InputError
from extrap_train.store.manifest import MANIFEST, Manifest, Split
from extrap_train.store.records import write_record
from extrap_train.tasks import category
from extrap_train.tasks.training_data import require_unseen


def _split(
    test: int, seed: int | None = 0, of: str = "hydrant", source: str = "synthetic"
) -> Manifest:
    """Manifest of a run whose first `test` captures are held out."""
    names = tuple(f"{index:04d}" for index in range(12))
    return Manifest.of({}, {}, {of: Split(source, names[test:], names[:test], seed)})


def _model(run: Path, start: str | None, manifest: Manifest | None) -> str:
    """The model's folder of a run that began with `start`."""
    folder = run / "model"
    folder.mkdir(parents=True)
    options = json.loads((packaged_weights("base") / MODEL_CONFIG).read_text())
    (folder / MODEL_CONFIG).write_text(json.dumps(options | {"start": start}))
    if manifest is not None:
        write_record(run / MANIFEST, manifest)
    return str(folder)


@pytest.mark.parametrize(
    ("seen", "leaked"),
    [
        (Split("synthetic", ("0001", "0000", "0007"), (), 0), ["0000", "0001"]),
        (Split("synthetic", ("0001",), (), None), ["0001"]),
        (Split("synthetic", ("0001",), (), 1), []),
        (Split("co3d", ("0001",), (), None), []),
        (Split("synthetic", ("0002",), ("0001",), 0), []),
    ],
)
def test_a_capture_leaks_if_it_is_held_out_here_and_trained_on_there(
    seen: Split, leaked: list[str]
) -> None:
    held_out = Split("synthetic", ("0002", "0003"), ("0000", "0001"), seed=0)
    assert TrainedCaptures("m", "hydrant", seen).find_leaks("hydrant", held_out) == leaked
    assert TrainedCaptures("m", "apple", seen).find_leaks("hydrant", held_out) == []


def test_captures_of_co3d_are_the_same_in_every_category() -> None:
    training = TrainedCaptures("m", "hydrant", Split("co3d", ("106_1_2",), ()))
    assert training.find_leaks("apple", Split("co3d", (), ("106_1_2",))) == ["106_1_2"]


@pytest.mark.parametrize("name", packaged_names())
def test_every_packaged_model_says_what_it_has_seen(name: str) -> None:
    require_unseen(name, _split(SyntheticConfig().test_sequences))
    said = rf"start={name} was trained on 0005, 0006 of hydrant, .*data\.test_sequences=5 or fewer"
    with pytest.raises(InputError, match=rf"{said}, another data\.seed, or model\.start=null"):
        require_unseen(name, _split(7))


@pytest.mark.parametrize(
    "unseen",
    [
        _split(7, seed=1),
        _split(7, of="vase"),
        _split(7, source="co3d"),
    ],
)
def test_what_is_only_called_alike_is_not_the_same(unseen: Manifest) -> None:
    require_unseen("base", unseen)


def test_random_weights_have_seen_nothing() -> None:
    require_unseen(None, _split(7))


def test_a_start_goes_back_to_its_own_start(tmp_path: Path) -> None:
    """Its run, of other objects, says nothing of what the packaged base has seen."""
    own = _model(tmp_path / "run", "base", _split(5, of="vase"))
    require_unseen(own, _split(5))
    with pytest.raises(InputError, match=r"0005, 0006 of hydrant, by way of base"):
        require_unseen(own, _split(7))


def test_a_run_counts_for_what_it_was_trained_on(tmp_path: Path) -> None:
    own = _model(tmp_path / "run", None, _split(2, seed=3))
    require_unseen(own, _split(2, seed=3))
    with pytest.raises(InputError, match=r"0002, 0003, 0004 and 2 more .*test_sequences=2 or"):
        require_unseen(own, _split(7, seed=3))
    with pytest.raises(InputError, match="0002"):
        require_unseen(own, _split(7, seed=None))


@pytest.mark.parametrize("content", ["", "[" * 20_000, '{"split": {"hydrant": []}}', "{}"])
def test_a_start_with_a_damaged_manifest_is_refused(tmp_path: Path, content: str) -> None:
    own = _model(tmp_path / "run", None, _split(2))
    (tmp_path / "run" / MANIFEST).write_text(content)
    with pytest.raises(InputError, match=r"manifest\.json"):
        require_unseen(own, _split(2))


def test_a_model_that_says_nothing_is_taken_at_that(tmp_path: Path) -> None:
    require_unseen(_model(tmp_path / "run", None, None), _split(7))
    require_unseen(str(tmp_path / "published.ckpt"), _split(7))


def test_a_training_that_would_hold_out_what_its_start_has_seen_is_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(category, "data_module", lambda *_: None)
    monkeypatch.setattr(category, "run_manifest", lambda *_: _split(7))
    config = TrainConfig(
        category=CategoryConfig("hydrant", ["hydrant"]),
        data=SyntheticConfig(test_sequences=7),
        depth=DatasetDepthConfig(),
        matcher=FlowMatcherConfig(),
        model=ModelConfig(name="small", start="base"),
        output=str(tmp_path / "out"),
    )
    with pytest.raises(InputError, match="start=base was trained on 0005, 0006"):
        category.run(config, lambda _: [])
    assert not (tmp_path / "out").exists()
