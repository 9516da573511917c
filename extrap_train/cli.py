"""The command line of every Hydra entry point: typed configuration in, one clear line out when it
is wrong.
"""

import difflib
import errno
import os
import re
import sys
from collections.abc import Callable
from dataclasses import fields
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
from extrap_train.tasks import TASKS

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS)
"""What a full or closed disk says, wherever it is written to."""
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


def register_schemas() -> None:
    """Make the dataclasses known to Hydra, as `<name>_schema`."""
    store = ConfigStore.instance()
    store.store(name="train_schema", node=schema.TrainConfig)
    store.store(name="prep_schema", node=schema.DataPrepConfig)
    for group, variants in _GROUPS.items():
        for variant in variants:
            name = variant.name if len(variants) > 1 else group  # type: ignore[attr-defined]
            store.store(group=group, name=f"{name}_schema", node=variant)


def command(name: str, run: Callable[[Any], Path | None]) -> None:
    """Compose the configuration `conf/<name>.yaml` with the command line's overrides and run it.

    `run` may return its result's folder: a sweep takes the numbers of its `summary.json`.

    An option that does not exist, a value of the wrong type, an unknown category and unusable input
    end with one line on stderr and exit status 1.
    """
    register_schemas()

    @hydra.main(version_base="1.3", config_path="pkg://conf", config_name=name)
    def composed(config: DictConfig) -> Path | None:
        try:
            typed = typed_config(config)
            _check_processes(typed)
            _use_threads(getattr(typed, "threads", None))
            return run(typed)
        except InputError as error:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise  # the other jobs of a sweep still run
            sys.exit(f"error: {error}")  # before Hydra adds a line of its own
        except OSError as error:
            output = getattr(typed, "output", ".")
            if not _is_of_output(error, output) or HydraConfig.get().mode == RunMode.MULTIRUN:
                raise
            where = error.filename or output
            sys.exit(f"error: {where}: {error.strerror}; free space or choose another output=")

    try:
        _check(name, sys.argv[1:])
        os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # what is left to go wrong is a bug
        composed()
    except InputError as error:
        sys.exit(f"error: {error}")
    except (HydraException, OmegaConfBaseException) as error:
        sys.exit(f"error: {_one_line(error, _overrides(sys.argv[1:]))}")
    except KeyboardInterrupt:
        sys.exit("interrupted: run the same command again to resume")


def _is_of_output(error: OSError, output: str) -> bool:
    """Whether it says that nothing can be written where it should be."""
    if error.errno in _NO_ROOM:
        return True
    place = Path(str(error.filename)).absolute()
    is_below = place.is_relative_to(Path(output).absolute())
    return error.errno in _NO_FOLDER and is_below and not Path(output).is_dir()


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


def _check(name: str, arguments: list[str]) -> None:
    """Compose once before Hydra does, so that its errors fit one line with a suggestion."""
    overrides = _overrides(arguments)
    if {"--help", "-h"} & set(arguments):
        if not any(o.startswith(("category=", "experiment=")) for o in overrides):
            sys.argv.append("category=hydrant")  # help shows a whole tree
        return
    if {"-m", "--multirun", "--hydra-help", "--version", "--info", "-i"} & set(arguments):
        return
    try:
        with hydra.initialize_config_module("conf", version_base="1.3"):
            typed_config(hydra.compose(name, overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(_one_line(error, overrides)) from None


def _overrides(arguments: list[str]) -> list[str]:
    """What is left without flags and the value that some of Hydra's take."""
    valued = {"--cfg", "-c", "--package", "-p", "--config-name", "-cn", "--config-dir", "-cd"}
    return [
        argument
        for before, argument in zip(["", *arguments], arguments, strict=False)
        if not argument.startswith("-") and before not in valued
    ]


def _one_line(error: Exception, overrides: list[str]) -> str:
    text = " ".join(f"{error} {error.__cause__ or ''}".split())
    group = re.search(
        r"Could not find '(\w+)/([^']+)' Available options in '\w+': (.*?)(?= Config)", text
    )
    if group:
        kind, value, known = group.groups()
        names = [n for n in known.split() if not n.endswith("_schema")]
        return f"{kind}={value} is unknown{_suggest(value, names)}; known: {', '.join(names)}"
    required = re.search(r"You must specify '(\w+)'.*?Available options:(.*)", text)
    if required:
        names = [n for n in required[2].split() if not n.endswith("_schema")]
        return f"{required[1]} is not given: {required[1]}={'|'.join(names)}"
    unknown = re.search(r"Key '(\w+)' (?:is )?not in", text) or re.search(
        r"Could not override '([\w.]+)'", text
    )
    if unknown:
        keys = [o.partition("=")[0].lstrip("+~") for o in overrides]
        given = next((key for key in keys if key.endswith(unknown[1])), unknown[1])
        return f"there is no option {given}{_suggest(given, _known_options())}; see --help"
    return text


def _known_options() -> list[str]:
    tree: Any = OmegaConf.to_container(OmegaConf.structured(schema.TrainConfig))
    variants = [(group, variant) for group, all_ in _GROUPS.items() for variant in all_]
    names = [f"{group}.{field.name}" for group, variant in variants for field in fields(variant)]
    return [*schema.dotted(tree), *names, *_GROUPS]


def _suggest(given: str, known: list[str]) -> str:
    near = difflib.get_close_matches(given, known, n=1, cutoff=0.5)
    return f"; did you mean {near[0]}?" if near else ""


def _use_threads(threads: int | None) -> None:
    if threads is not None:
        os.environ["OMP_NUM_THREADS"] = str(threads)
        os.environ["NUMBA_NUM_THREADS"] = str(threads)
