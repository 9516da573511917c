"""Runs as `task=category` opens them, without training."""

from pathlib import Path

from extrap_train.config import (
    CategoryConfig,
    FlowMatcherConfig,
    ModelConfig,
    SyntheticConfig,
    TrainConfig,
)
from extrap_train.config import DatasetDepthConfig as Depth
from extrap_train.diffusion.footprint import Footprint
from extrap_train.runs import (
    RunFolder,
    require_same_options,
    run_folder,
    run_identity,
)
from extrap_train.store.manifest import Manifest, Split
from extrap_train.tasks.category import _open_run
from extrap_train.terminal import terminal

_SPLIT = Split("synthetic", ("0001",), ("0000",))


def hydrant_config(output: Path) -> TrainConfig:
    return TrainConfig(
        category=CategoryConfig("hydrant", ["hydrant"]),
        data=SyntheticConfig(),
        depth=Depth(),
        matcher=FlowMatcherConfig(),
        model=ModelConfig(name="small"),
        output=str(output),
    )


def opened(config: TrainConfig, key: str = "key") -> RunFolder:
    """The run, on the data of this key, as `task=category` opens it."""
    folder = run_folder(config)
    require_same_options(folder, config)
    inputs = {"data of hydrant": key}
    manifest = Manifest.of(run_identity(config), inputs, {"hydrant": _SPLIT})
    with _open_run(folder, config, manifest, Footprint(0, 0), terminal(quiet=True)):
        return folder


def begun(config: TrainConfig) -> RunFolder:
    """The run with its first checkpoint."""
    run = opened(config)
    run.checkpoints.mkdir(exist_ok=True)
    (run.checkpoints / "step-00000003.ckpt").touch()  # damaged, and passed over
    return run
