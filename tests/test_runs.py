"""The same command finds its run again; another one never writes into it unasked."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from extrap_train.config import (
    CategoryConfig,
    Co3dConfig,
    FlowMatcherConfig,
    ModelConfig,
    SamplerConfig,
    SamplerOptions,
    SyntheticConfig,
    TrainConfig,
)
from extrap_train.config import DatasetDepthConfig as Depth
from extrap_train.errors import InputError
from extrap_train.runs import RunFolder, _runs_of, existing_run, open_run, point_latest
from extrap_train.trained_on import CategoryData, TrainedOn

"""Of the default run of a category, from when the last option was added that had to rename it."""


_DATA = TrainedOn({"hydrant": CategoryData("synthetic", "key", "split", ("0001",), ("0000",))})


def opened(config: TrainConfig) -> RunFolder:
    """The run, on data that stay the same."""
    return open_run(config, _DATA)


def begun(config: TrainConfig) -> RunFolder:
    """The run with its first checkpoint."""
    run = opened(config)
    run.checkpoints.mkdir(exist_ok=True)
    (run.checkpoints / "step-00000003.ckpt").touch()
    return run


@pytest.fixture
def config(tmp_path: Path) -> TrainConfig:
    return TrainConfig(
        category=CategoryConfig("hydrant", ["hydrant"]),
        data=SyntheticConfig(),
        depth=Depth(),
        matcher=FlowMatcherConfig(),
        model=ModelConfig(name="small"),
        output=str(tmp_path),
    )


def test_the_same_options_find_the_same_folder(config: TrainConfig, tmp_path: Path) -> None:
    first = opened(config)
    assert opened(config) == first


def test_latest_moves_only_when_told(config: TrainConfig, tmp_path: Path) -> None:
    """A run whose data turn out to be unusable leaves the link at the last good one."""
    latest = tmp_path / "train/hydrant/small/latest"
    first = opened(config)
    assert not latest.exists()
    point_latest(first)
    second = opened(replace(config, seed=1))
    assert latest.resolve() == first.path.resolve()
    point_latest(second)
    assert latest.resolve() == second.path.resolve()


def test_other_options_are_another_run(config: TrainConfig) -> None:
    assert opened(replace(config, seed=1)) != opened(config)


def test_a_longer_training_is_the_same_run(config: TrainConfig) -> None:
    longer = replace(config, trainer=replace(config.trainer, steps=10 * config.trainer.steps))
    assert opened(longer) == opened(config)


def test_resuming_a_named_run_with_other_options_says_which(config: TrainConfig) -> None:
    begun(replace(config, run="mine"))
    changed = replace(config, run="mine", model=replace(config.model, learning_rate=0.5))
    with pytest.raises(InputError, match=r"model\.learning_rate \(was 0\.0003, now 0\.5\)"):
        opened(changed)
    opened(replace(changed, resume=False))


def test_an_option_that_is_new_since_had_its_default(config: TrainConfig) -> None:
    saved = begun(replace(config, run="mine")).options
    options = yaml.safe_load(saved.read_text())
    del options["trainer"]["min_snr"]
    saved.write_text(yaml.safe_dump(options))
    opened(replace(config, run="mine"))
    saved.write_text(yaml.safe_dump(options))
    changed = replace(config.trainer, min_snr=5.0)
    with pytest.raises(InputError, match=r"min_snr \(was None, now 5\.0\)"):
        opened(replace(config, run="mine", trainer=changed))


def test_what_a_model_recommends_is_part_of_the_run_as_far_as_it_is_used(
    config: TrainConfig,
) -> None:
    """Said by the command or by the model: the same run, and its file spells it out."""
    said = replace(config, sampler=SamplerOptions(steps=50))
    model = replace(config.model, sampler=SamplerConfig(steps=50))
    run = opened(said)
    assert opened(replace(config, model=model)) == run != opened(config)
    assert opened(replace(said, model=replace(model, sampler=SamplerConfig(steps=9)))) == run
    assert yaml.safe_load((run.path / "config.yaml").read_text())["sampler"]["steps"] == 50


def test_starting_over_leaves_nothing_of_the_run(config: TrainConfig) -> None:
    """Else a new run that is killed early would be taken for the finished old one, or would lie
    beside its pictures and model."""
    run = begun(config)
    run.summary.write_text("{}")
    for part in (run.model, run.samples, run.path / "tensorboard"):
        part.mkdir()
        (part / "file").touch()
    (run.path / "validation.csv").touch()
    opened(config)
    assert run.summary.exists()
    assert (run.model / "file").exists()
    opened(replace(config, resume=False))
    assert {path.name for path in run.path.iterdir()} == {"config.yaml", "data.json"}
    assert [path.name for path in run.path.parent.iterdir()] == [run.path.name]


def test_a_run_that_has_learnt_nothing_binds_nobody(config: TrainConfig) -> None:
    """Neither to its options nor to its data, as where it was killed before a checkpoint."""
    mine = replace(config, run="mine")
    run = opened(mine)
    (run.path / "metrics.csv").touch()
    other = TrainedOn({"hydrant": replace(_DATA.categories["hydrant"], key="other")})
    changed = replace(mine, model=replace(config.model, learning_rate=0.5))
    assert open_run(changed, other) == run
    assert TrainedOn.read(run.data) == other
    assert yaml.safe_load(run.options.read_text())["model"]["learning_rate"] == 0.5
    assert {path.name for path in run.path.iterdir()} == {"config.yaml", "data.json"}


@pytest.mark.parametrize("mark", ["checkpoints/step-00000003.ckpt", "summary.json", "model/unet"])
def test_a_run_that_has_learnt_is_not_opened_with_other_data(
    config: TrainConfig, mark: str
) -> None:
    run = opened(config)
    (run.path / mark).parent.mkdir(exist_ok=True)
    (run.path / mark).touch()
    before = {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}
    other = TrainedOn({"hydrant": replace(_DATA.categories["hydrant"], key="other")})
    longer = replace(config, trainer=replace(config.trainer, steps=9))
    with pytest.raises(InputError, match="its data have changed"):
        open_run(longer, other)
    assert {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()} == before


def test_another_download_is_another_run(config: TrainConfig) -> None:
    one, two = (replace(config, data=Co3dConfig(root=root)) for root in ("one", "two"))
    assert opened(one) != opened(two)
    moved = replace(config, data=SyntheticConfig(root="elsewhere"))
    assert opened(moved) == opened(config)


def test_the_same_download_is_the_same_run_however_its_path_is_spelled(
    config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "co3d").mkdir()
    (tmp_path / "link").symlink_to("co3d")
    monkeypatch.chdir(tmp_path)
    spelled = ["co3d", "co3d/", "link", f"{tmp_path}/link/../co3d", str(tmp_path / "co3d")]
    for name in (None, "mine"):
        runs = {
            begun(replace(config, run=name, data=Co3dConfig(root=root))).path for root in spelled
        }
        assert len(runs) == 1
    saved = runs.pop() / "config.yaml"
    assert yaml.safe_load(saved.read_text())["data"]["root"] == str(tmp_path / "co3d")
    saved.write_text(saved.read_text().replace(str(tmp_path / "co3d"), "link/"))  # by an older one
    opened(replace(config, run="mine", data=Co3dConfig(root="co3d")))


def test_a_start_is_a_path_where_there_is_one(
    config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(value: str) -> RunFolder:
        return opened(replace(config, model=replace(config.model, start=value)))

    monkeypatch.chdir(tmp_path)
    named = start("base")
    (tmp_path / "base").mkdir()
    assert start("base") == start("./base/") != named


@pytest.mark.parametrize(
    "option",
    [
        {"workers": 2},
        {"accelerator": "cpu"},
        {"checkpoint_every": 40},
        {"validate_every": 800},
        {"steps": 9},
    ],
)
def test_what_changes_nothing_learnt_is_the_same_run(
    config: TrainConfig, option: dict[str, Any]
) -> None:
    changed = replace(config, trainer=replace(config.trainer, **option))
    assert opened(changed) == opened(config)
    begun(replace(config, run="mine"))
    opened(replace(changed, run="mine"))


@pytest.mark.parametrize("name", ["latest", "../other", "a/b", ".", "..", "a/", "a\\b", "/a"])
def test_a_run_has_the_name_of_a_folder(config: TrainConfig, name: str) -> None:
    """Else `resume=false` would remove what lies beside or above all runs."""
    precious = _runs_of(config) / "summary.json"
    precious.parent.mkdir(parents=True)
    precious.touch()
    for find in (opened, existing_run):
        with pytest.raises(InputError, match="must be the name of a folder"):
            find(replace(config, run=name, resume=False))
    assert precious.exists()


def test_options_that_are_no_text_are_one_line(config: TrainConfig) -> None:
    saved = begun(replace(config, run="mine")).options
    saved.write_bytes(b"\xff\xfe\xfa")
    with pytest.raises(InputError, match=r"unreadable.*choose run=NAME"):
        opened(replace(config, run="mine"))


def test_a_set_list_makes_another_run(config: TrainConfig) -> None:
    download = Co3dConfig(root="/data/co3d")
    divided = replace(download, set_list="fewview_dev")
    assert opened(replace(config, data=divided)) != opened(replace(config, data=download))
