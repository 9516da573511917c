"""The command line of every Hydra entry point: typed configuration in, one clear line out when it
is wrong.
"""

import errno
import os
import sys
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from extrap_train import config as schema
from extrap_train.errors import InputError
from extrap_train.exits import ends_in_one_line
from extrap_train.option_errors import options_of
from extrap_train.tasks import TASKS

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)
"""What a full disk says, wherever it is written to."""
_CLOSED = (errno.EACCES, errno.EROFS)
"""What is said of a place that may not be read or written."""
_NO_FOLDER = (errno.ENOTDIR, errno.ENOENT, errno.EEXIST)
"""What is said below an output that can be no folder."""

_GROUPS: dict[str, list[type]] = {
    "category": [schema.CategoryConfig],
    "data": [schema.SyntheticConfig, schema.Co3dConfig],
    "depth": [
        schema.DatasetDepthConfig,
        schema.StereoConfig,
        schema.Mast3rConfig,
        schema.MonocularConfig,
    ],
    "matcher": [
        schema.FlowMatcherConfig,
        schema.LoftrMatcherConfig,
        schema.AlikedMatcherConfig,
    ],
    "launcher": [schema.LocalConfig, schema.SlurmConfig],
    "model": [schema.ModelConfig],
}

_COMMANDS: dict[str, tuple[type, dict[str, list[type]], tuple[str, ...]]] = {
    "train": (schema.TrainConfig, _GROUPS, ("experiment", "sweep")),
    "prep": (schema.DataPrepConfig, _GROUPS, ()),
}
"""Tree, groups that it may have, and further choices of each command, by its file's name."""


def register_schemas() -> None:
    """Make the dataclasses known to Hydra, as `<name>_schema`, and choices to its help."""
    OmegaConf.register_new_resolver("choices", _choices, replace=True)
    store = ConfigStore.instance()
    store.store(name="train_schema", node=schema.TrainConfig)
    store.store(name="prep_schema", node=schema.DataPrepConfig)
    for group, variants in _GROUPS.items():
        for variant in variants:
            name = variant.name if len(variants) > 1 else group  # type: ignore[attr-defined]
            store.store(group=group, name=f"{name}_schema", node=variant)


def _choices(*groups: str, _root_: Any) -> str:
    """What may be chosen of each group, a line each; folders of one's own (`--config-dir`) count.

    Hydra's own list has the schemas, too, which are no choices, and every group that there is.
    """
    sources = [s for s in _root_.hydra.runtime.config_sources if s.schema in ("pkg", "file")]
    folders = [files(s.path) if s.schema == "pkg" else Path(s.path) for s in sources]
    lines = []
    for group in groups:
        places = [Path(str(folder)) / group for folder in folders]
        names = {
            file.relative_to(place).with_suffix("").as_posix()
            for place in places
            for file in place.rglob("*.yaml")
        }
        lines.append(f"{group}: {', '.join(sorted(names))}")
    return "\n".join(lines)


def command(name: str, run: Callable[[Any], Path | None]) -> None:
    """Compose the configuration `conf/<name>.yaml` with the command line's overrides and run it.

    `run` may return its result's folder: a sweep takes the numbers of its `summary.json`.

    An option that does not exist, a value of the wrong type, an unknown category and unusable input
    end with one line on stderr and exit status 1.
    """
    register_schemas()

    def checked(config: DictConfig) -> Path | None:
        output = "."
        try:
            typed = typed_config(config)
            output = typed.output
            _check_processes(typed)
            _use_threads(getattr(typed, "threads", None))
            return run(typed)
        except OSError as error:
            said = _remedy(error, output)
            if said is None:
                raise
            message = f"{error.filename or output}: {error.strerror}; {said}"
            raise InputError(message) from error

    @hydra.main(version_base="1.3", config_path="pkg://conf", config_name=name)
    def composed(config: DictConfig) -> Path | None:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            return checked(config)  # the other jobs of a sweep still run
        with ends_in_one_line():  # before Hydra adds a line of its own
            return checked(config)

    with ends_in_one_line():
        try:
            _complete_help(sys.argv)
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # what is left to go wrong is a bug
            composed()
        except (HydraException, OmegaConfBaseException) as error:
            options = options_of(*_COMMANDS[name])
            raise InputError(options.one_line(error, _overrides(sys.argv[1:]))) from None


def _remedy(error: OSError, output: str) -> str | None:
    """What a user can do about it; None where it says nothing of a disk or folder of theirs."""
    place = Path(str(error.filename or output))
    is_of_output = _is_of_output(place.absolute(), Path(output).absolute())
    if error.errno in _NO_ROOM or (is_of_output and error.errno in _CLOSED):
        return "free space or choose another output="
    if is_of_output and error.errno in _NO_FOLDER and not Path(output).is_dir():
        return "choose another output="
    if error.errno in _CLOSED:
        return "change its rights, or name another place"
    return None


def _is_of_output(place: Path, output: Path) -> bool:
    """Whether it lies below the output, or is a folder above that could not be made."""
    is_missing_parent = output.is_relative_to(place) and not os.access(place, os.F_OK)
    return place.is_relative_to(output) or is_missing_parent


def typed_config(config: DictConfig) -> Any:
    """The dataclass tree of a composed configuration, checked beyond its types."""
    missing = sorted(str(key) for key in OmegaConf.missing_keys(config) if key != "hydra")
    if missing:
        raise InputError(f"an option has no value: give {missing[0]}=VALUE")
    typed: Any = OmegaConf.to_object(config)
    schema.validate(typed, TASKS)
    return typed


def _check_processes(config: Any) -> None:
    """Lightning starts a run's other processes with the whole command: that is the whole sweep."""
    devices = config.trainer.devices if isinstance(config, schema.TrainConfig) else 1
    if devices > 1 and HydraConfig.get().mode == RunMode.MULTIRUN:
        raise InputError(
            f"trainer.devices={devices}: a job of a sweep trains on one device; leave it out or "
            "start the runs one by one"
        )


def _complete_help(words: list[str]) -> None:
    """Help shows a whole tree, for which something must be chosen; `words` are the command's."""
    overrides = _overrides(words[1:])
    if not {"--help", "-h"} & set(words) or any(
        override.startswith(("category=", "experiment=")) for override in overrides
    ):
        return
    place = words.index(overrides[0]) if overrides else len(words)  # they must stand together
    words.insert(place, "category=hydrant")


def _overrides(arguments: list[str]) -> list[str]:
    """What is no flag of Hydra's, nor looks like the value of one."""
    return [w for w in arguments if not w.startswith("-") and ("=" in w or w.startswith("~"))]


def _use_threads(threads: int | None) -> None:
    if threads is not None:
        os.environ["OMP_NUM_THREADS"] = str(threads)
        os.environ["NUMBA_NUM_THREADS"] = str(threads)
