"""`sweep=options` names every option's file, and trains a run before it is measured again."""

from pathlib import Path

import hydra
import pytest
from omegaconf import OmegaConf

import conf
from extrap_train.cli import register_schemas, typed_config
from extrap_train.config import TrainConfig, dotted
from extrap_train.runs import run_identity

_CONF = Path(conf.__path__[0])


@pytest.fixture(scope="module")
def options() -> dict[str, TrainConfig]:
    """What each job of the sweep is told, in the sweep's order."""
    sweep = OmegaConf.load(_CONF / "sweep/options.yaml")
    names = sweep.hydra.sweeper.params.experiment.split(",")
    register_schemas()
    with hydra.initialize_config_module("conf", version_base="1.3"):
        words = ["category=hydrant", "sweep=options", "seed=2"]
        return {
            name: typed_config(hydra.compose("train", [*words, f"experiment={name}"]))
            for name in names
        }


def test_every_option_is_swept(options: dict[str, TrainConfig]) -> None:
    files = {f"options/{file.stem}" for file in (_CONF / "experiment/options").glob("*.yaml")}
    assert set(options) == files
    assert next(iter(options)) == "options/default", "the first is what others are compared with"


def test_what_is_measured_again_was_trained_before(options: dict[str, TrainConfig]) -> None:
    trained = set()
    for name, config in options.items():
        assert config.run is not None
        assert config.run.endswith("-seed2"), "seeds must not share a run"
        if config.task == "category":
            trained.add(config.run)
            assert config.run == f"{name.removeprefix('options/')}-seed2"
        else:
            assert config.run in trained


def test_an_option_differs_from_the_default_in_what_it_is_named_for(
    options: dict[str, TrainConfig],
) -> None:
    default = run_identity(options["options/default"])
    changed = {
        name: {k for k, v in run_identity(config).items() if v != default[k]} - {"task"}
        for name, config in options.items()
    }
    assert changed["options/min_snr"] == {"trainer.min_snr"}
    assert changed["options/geometry"] == {"model.geometry"}
    assert changed["options/v_prediction"] == {"model.prediction"}
    for name, config in options.items():
        if config.task == "validate":
            assert all(key.startswith("sampler.") for key in changed[name])
            assert changed[name]


def test_the_sweep_changes_no_other_run(options: dict[str, TrainConfig]) -> None:
    """Its runs lie apart, so that `latest` goes on meaning the user's own."""
    assert {config.output for config in options.values()} == {"outputs/options"}
    with hydra.initialize_config_module("conf", version_base="1.3"):
        plain = hydra.compose("train", ["category=hydrant"])
    assert "sweep" not in dotted(OmegaConf.to_container(plain))  # type: ignore[arg-type]
