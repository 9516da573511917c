"""The folder of a training run: its name, its manifest, and which run is the latest."""

import os
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from extrap_train.config import (
    SceneOptions,
    SyntheticConfig,
    TrainConfig,
    dotted,
    packaged_names,
    resolve_paths,
)
from extrap_train.data.prepared import PreparedData
from extrap_train.diffusion.hub import is_repository, weights_folder
from extrap_train.errors import InputError
from extrap_train.store.atomic import partial_path, write_atomic
from extrap_train.store.digests import folder_digest, json_digest, weights_digest
from extrap_train.store.manifest import (
    REMEDY,
    Manifest,
    Split,
    code_version,
    package_versions,
    read_manifest,
    require_same,
)
from extrap_train.store.records import read_record, read_yaml

_NOT_PART_OF_THE_RUN = (
    "output",
    "run",
    "repo",
    "resume",
    "shards",
    "threads",
    "logger",
    "validation",
    "trainer.steps",
    "trainer.gradient_checkpointing",
    "trainer.deterministic",
    "trainer.compile",
    "trainer.latents",
    "trainer.accelerator",
    "trainer.workers",
    "trainer.checkpoint_every",
    "trainer.validate_every",
    "complete",
    "studio",
    "model.sampler",
    *(field.name for field in fields(SceneOptions)),
)
"""May differ on resume: where things lie, how they are measured, how long is trained, how often
that is saved, how the machine goes about the same mathematics, and what other tasks read. What the
model recommends to sample with is part of the run as far as it is used, under `sampler`.
"""

_MAX_NAME_BYTES = 150
"""Longest name of a result's folder: files beside it add the writer to it, within 255 bytes."""
_LATEST = "latest"
"""Link to the newest run of a model and category."""


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
        """Picture sheets, one per validation."""
        return self.path / "samples"

    @property
    def model(self) -> Path:
        """The trained model as a diffusers folder."""
        return self.path / "model"

    @property
    def summary(self) -> Path:
        """The result; a run that has it for the wanted number of steps is finished."""
        return self.path / "summary.json"

    @property
    def options(self) -> Path:
        """What the run was started with."""
        return self.path / "config.yaml"

    @property
    def has_learnt(self) -> bool:
        """Whether there is something that other options or data would not have led to."""
        return self.summary.is_file() or self.model.exists() or any(self.checkpoints.glob("*.ckpt"))


@dataclass(frozen=True)
class _HowMeasured:
    validation: Mapping[str, Any]


@dataclass(frozen=True)
class Finished:
    """What the summary of a finished run says of it."""

    steps: int
    provenance: _HowMeasured
    model_sha256: str | None = None
    """Digest of the folder of the model that was measured."""

    @classmethod
    def read(cls, folder: RunFolder) -> "Finished":
        """The record of a run that has a summary; InputError if that is damaged."""
        remedy = "delete it, and task=category measures the run again"
        return read_record(folder.summary, cls, remedy)

    def answers(self, config: TrainConfig) -> bool:
        """Whether the run was trained for at least these steps and measured in this way."""
        measured = dict(self.provenance.validation) == asdict(config.validation)
        return self.steps >= config.trainer.steps and measured

    def has_its_model(self, folder: RunFolder) -> bool:
        """Whether the run's model is there as it was measured."""
        said = self.model_sha256
        return said is None or (folder.model.is_dir() and folder_digest(folder.model) == said)

    def require_its_model(self, folder: RunFolder) -> None:
        """InputError if the run's model is missing or was changed since."""
        if not self.has_its_model(folder):
            raise InputError(
                f"{folder.model}: is missing, damaged or was changed since its run measured it; "
                "run the command of its training again, which restores it"
            )


def in_sweep() -> bool:
    """Whether this process runs a job of a sweep."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def run_identity(config: TrainConfig) -> dict[str, Any]:
    """The options that make a run what it is, by dotted key.

    The data's root is one of them, except for synthetic data, which is the same wherever it lies;
    in a sweep so are length and validation: no job takes or prolongs a run of another length.
    """
    left_out = {*_NOT_PART_OF_THE_RUN} - ({"validation", "trainer.steps"} if in_sweep() else set())
    if isinstance(config.data, SyntheticConfig):
        left_out.add("data.root")
    return {
        key: value
        for key, value in dotted(_all_options(config)).items()
        if not any(key == name or key.startswith(f"{name}.") for name in left_out)
    }


def _all_options(config: TrainConfig) -> dict[str, Any]:
    """All options, with the sampler as it is used: what the model recommends is spelled out; paths
    as they lead from everywhere.
    """
    sampler = config.sampler.over(config.model.sampler)
    return asdict(resolve_paths(config)) | {"sampler": asdict(sampler)}


def run_folder(config: TrainConfig) -> RunFolder:
    """Where the run lies or will lie; raises InputError if no folder may be called so."""
    name = given_name(config) or f"seed{config.seed}-{json_digest(run_identity(config))[:8]}"
    return RunFolder(_runs_of(config) / name)


def run_manifest(config: TrainConfig, prepared: list[PreparedData]) -> Manifest:
    """What the run follows from: its options, the prepared data, and the weights it starts from."""
    inputs, split = trained_on(config, prepared)
    start = config.model.start
    if start is not None and is_repository(start):
        inputs["model.start"] = weights_digest(weights_folder(start, "model.start"))
    elif start is not None and start not in packaged_names() and Path(start).exists():
        inputs["model.start"] = weights_digest(Path(start))
    return Manifest.of(run_identity(config), inputs, split)


def trained_on(
    config: TrainConfig, prepared: list[PreparedData]
) -> tuple[dict[str, str], dict[str, Split]]:
    """The digests of the member categories' data, and their captures for training and testing."""
    members = list(zip(config.category.members, prepared, strict=True))
    inputs = {f"data of {member}": data.manifest["key"] for member, data in members}
    inputs |= {f"held-out frames of {member}": data.manifest["split"] for member, data in members}
    return inputs, {member: _split(data) for member, data in members}


def _split(prepared: PreparedData) -> Split:
    data = prepared.manifest["data"] or {}
    train, test = (
        tuple(
            sorted(
                name.split("/", 1)[1]
                for name, role in prepared.roles.items()
                if (role == "test") is held_out
            )
        )
        for held_out in (False, True)
    )
    return Split(data.get("name", ""), train, test, data.get("seed"))


def require_same_options(folder: RunFolder, config: TrainConfig) -> None:
    """Raise Conflict if the run is to be resumed and has learnt with other options.

    Asked before the data are there.
    """
    if not (config.resume and folder.has_learnt):
        return
    before = read_manifest(folder.path)
    require_same(folder.path, Manifest.of(run_identity(config), before.inputs, before.split))
    if folder.options.exists() and "trainer" not in read_yaml(folder.options, REMEDY):
        raise InputError(f"{folder.options}: does not hold the options of a run; {REMEDY}")


def write_options(folder: RunFolder, config: TrainConfig, *, at_least: int) -> None:
    """Write `config.yaml`; if the run was already trained for more steps than asked, that
    number is kept.
    """
    options = _all_options(config)
    options["trainer"]["steps"] = max(config.trainer.steps, at_least)
    write_atomic(folder.options, yaml.safe_dump(options, sort_keys=False).encode())


def existing_run(config: TrainConfig) -> RunFolder:
    """The finished run that `run` names, by default the latest; InputError if there is none."""
    name = given_name(config)
    folder = RunFolder(_runs_of(config) / name) if name else newest_run(config)
    if not folder.summary.is_file():
        raise InputError(f"{folder.path}: holds no finished run; train one (task=category)")
    return folder


def newest_run(config: TrainConfig) -> RunFolder:
    """Where the category's latest run is, if there is one."""
    return RunFolder(_runs_of(config) / _LATEST)


def given_name(config: TrainConfig) -> str | None:
    """`run`, if that can be a folder among the runs and is not the link to the latest."""
    name = config.run
    if name and (name in (".", "..", _LATEST) or {"/", "\\", "\0"} & set(name)):
        raise InputError(f"run={name!r}: must be the name of a folder, other than {_LATEST}")
    return short_name(name) if name else None


def short_name(name: str) -> str:
    """`name`, if a result's folder may be called so; InputError if it is too long."""
    if (length := len(os.fsencode(name))) > _MAX_NAME_BYTES:
        raise InputError(
            f"{name[:20]!r}… is too long a name for a result ({length} bytes of at most "
            f"{_MAX_NAME_BYTES}): give a shorter run=NAME"
        )
    return name


def _runs_of(config: TrainConfig) -> Path:
    return Path(config.output) / "train" / config.category.name / config.model.name


def point_latest(folder: RunFolder) -> None:
    """Let `latest` mean this run, unless a sweep made it: its last job is not its best."""
    if in_sweep():
        return
    link = folder.path.with_name(_LATEST)
    if link.is_dir() and not link.is_symlink():  # as where the runs were copied without links
        raise InputError(f"{link}: is a folder, not the link to the latest run; rename it")
    temporary = partial_path(link)
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(folder.path.name)
    temporary.replace(link)


def provenance(config: TrainConfig, data_hashes: dict[str, str]) -> dict[str, Any]:
    """What a result was made with: configuration, data, seed, device and versions."""
    return {
        "config": json_digest(run_identity(config)),
        "data": data_hashes,
        "seed": config.seed,
        "start": config.model.start,
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else platform.machine(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "code": code_version(),
        "versions": package_versions(),
    }
