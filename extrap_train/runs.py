"""The folder of a training run: its name, its options, and whether it may be resumed."""

import hashlib
import json
import platform
import shutil
from dataclasses import MISSING, asdict, dataclass, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
import yaml

from extrap_train.config import (
    SceneOptions,
    SyntheticConfig,
    TrainConfig,
    dotted,
    placed,
    placed_value,
)
from extrap_train.errors import InputError
from extrap_train.store.atomic import partial_path, remove_leftovers, write_atomic
from extrap_train.trained_on import TRAINED_ON, TrainedOn

_NOT_PART_OF_THE_RUN = (
    "output",
    "run",
    "resume",
    "threads",
    "validation",
    "trainer.steps",
    "trainer.gradient_checkpointing",
    "trainer.compile",
    "trainer.accelerator",
    "trainer.workers",
    "trainer.checkpoint_every",
    "trainer.validate_every",
    "complete",
    "model.sampler",
    *(field.name for field in fields(SceneOptions)),
)
"""May differ on resume: where things lie, how they are measured, how long is trained, how often
that is saved, how the machine goes about the same mathematics, and what other tasks read. What the
model recommends to sample with is part of the run as far as it is used, under `sampler`.
"""

_LATEST = "latest"
"""Link to the newest run of a model and category."""
_PACKAGES = ("torch", "lightning", "diffusers", "numba", "numpy", "extrap-train")


@dataclass(frozen=True)
class RunFolder:
    """Where a run keeps what it makes."""

    path: Path

    @property
    def checkpoints(self) -> Path:
        """Complete checkpoints, named by their step."""
        return self.path / "checkpoints"

    @property
    def samples(self) -> Path:
        """Picture sheets, one a validation."""
        return self.path / "samples"

    @property
    def model(self) -> Path:
        """The trained model as a diffusers folder."""
        return self.path / "model"

    @property
    def data(self) -> Path:
        """What the run is trained on (`TrainedOn`)."""
        return self.path / TRAINED_ON

    @property
    def summary(self) -> Path:
        """The result; a run that has it for the wanted number of steps is finished."""
        return self.path / "summary.json"

    @property
    def options(self) -> Path:
        """What the run was started with."""
        return self.path / "config.yaml"

    @property
    def lock(self) -> Path:
        """Held by the process that trains the run; beside the folder, which may be removed."""
        return self.path.with_name(f".{self.path.name}.lock")

    @property
    def has_learnt(self) -> bool:
        """Whether there is something that other options or data would not have led to."""
        return self.summary.is_file() or self.model.exists() or any(self.checkpoints.glob("*.ckpt"))


def run_identity(config: TrainConfig) -> dict[str, Any]:
    """The options that make a run what it is, by dotted key.

    The data's root is one of them, but for synthetic data, which is the same wherever it lies.
    """
    left_out = list(_NOT_PART_OF_THE_RUN)
    if isinstance(config.data, SyntheticConfig):
        left_out.append("data.root")
    return {
        key: value
        for key, value in dotted(_said(config)).items()
        if not any(key == name or key.startswith(f"{name}.") for name in left_out)
    }


def _said(config: TrainConfig) -> dict[str, Any]:
    """All options, with the sampler as it is used: what the model recommends is spelled out; paths
    as they lead from everywhere.
    """
    return asdict(placed(config)) | {"sampler": asdict(config.sampler.over(config.model.sampler))}


def _digest(identity: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()


def run_folder(config: TrainConfig) -> RunFolder:
    """Where the run lies or will lie; raises InputError where no folder may be called so."""
    name = given_name(config) or f"seed{config.seed}-{_digest(run_identity(config))[:8]}"
    return RunFolder(_runs_of(config) / name)


def open_run(config: TrainConfig, trained_on: TrainedOn) -> RunFolder:
    """Make or find the run's folder, with its configuration and data; for one process alone.

    What an earlier run of that name left is removed with `resume=false`, or where it has learnt
    nothing. Raises InputError, and changes nothing, where it was started with other options or data
    and is to be resumed.
    """
    folder = run_folder(config)
    if config.resume and folder.has_learnt:
        require_same_options(folder, config)
        trained_on.require_same(folder.data)
    else:
        _start_over(folder)
        trained_on.write(folder.data)
    write_atomic(folder.options, yaml.safe_dump(_said(config), sort_keys=False).encode())
    return folder


def existing_run(config: TrainConfig) -> RunFolder:
    """The finished run that `run` names, by default the newest; InputError where there is none."""
    name = given_name(config)
    folder = RunFolder(_runs_of(config) / name) if name else newest_run(config)
    if not folder.summary.is_file():
        raise InputError(f"{folder.path}: holds no finished run; train one (task=category)")
    return folder


def newest_run(config: TrainConfig) -> RunFolder:
    """Where the category's newest run is, if there is one."""
    return RunFolder(_runs_of(config) / _LATEST)


def given_name(config: TrainConfig) -> str | None:
    """`run`, if that can be a folder among the runs and is not the link to the newest."""
    name = config.run
    if name and (name in (".", "..", _LATEST) or {"/", "\\", "\0"} & set(name)):
        raise InputError(f"run={name!r}: must be the name of a folder, other than {_LATEST}")
    return name


def _runs_of(config: TrainConfig) -> Path:
    return Path(config.output) / "train" / config.category.name / config.model.name


def _start_over(folder: RunFolder) -> None:
    """Remove the run at once: killed meanwhile, nothing of it is taken for the new one's."""
    remove_leftovers(folder.path.parent)
    if folder.path.exists():
        removed = partial_path(folder.path)
        folder.path.rename(removed)
        shutil.rmtree(removed)


def require_same_options(folder: RunFolder, config: TrainConfig) -> None:
    """InputError where the run is to be resumed and has learnt with other options.

    Options that the run's version did not have yet had their default.
    """
    saved = folder.options
    if not (config.resume and folder.has_learnt and saved.is_file()):
        return
    try:
        before = dotted(yaml.safe_load(saved.read_text()))
    except (yaml.YAMLError, UnicodeDecodeError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{saved}: unreadable ({reason}); remove the run or choose run=NAME"
        ) from None
    changed = [
        f"{key} (was {was}, now {value})"
        for key, value in run_identity(config).items()
        if (was := _before(before, key, config)) != value
    ]
    if changed:
        raise InputError(
            f"{saved.parent}: started with other options: {', '.join(changed)}; "
            "give them back their values, or choose another run=NAME, or resume=false to start over"
        )


def _before(options: dict[str, Any], key: str, config: TrainConfig) -> Any:
    """An option's value among a saved run's, or its default where it is newer than the run."""
    value = options[key] if key in options else _default(config, key)
    return placed_value(key.rpartition(".")[2], value)


def _default(config: Any, key: str) -> Any:
    """What the dataclass that holds the option starts it with."""
    if key.startswith("sampler."):
        key = f"model.{key}"  # whose default is a value; the command's is to say nothing
    *parents, name = key.split(".")
    for parent in parents:
        config = getattr(config, parent)
    option = next(field for field in fields(config) if field.name == name)
    return option.default if option.default_factory is MISSING else option.default_factory()


def point_latest(folder: RunFolder) -> None:
    """Let `latest` mean this run: once its data are known to be usable."""
    link = folder.path.with_name(_LATEST)
    temporary = partial_path(link)
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(folder.path.name)
    temporary.replace(link)


def provenance(config: TrainConfig, data_hashes: dict[str, str]) -> dict[str, Any]:
    """What a result was made with: configuration, data, seed, device and versions."""
    return {
        "config": _digest(run_identity(config)),
        "data": data_hashes,
        "seed": config.seed,
        "start": config.model.start,
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else platform.machine(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "versions": {name: package_version(name) for name in _PACKAGES},
    }


def package_version(name: str) -> str | None:
    """Of an installed package; None where it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None
