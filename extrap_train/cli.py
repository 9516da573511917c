"""The command line of every Hydra entry point: typed configuration in, one clear line out when it
is wrong.
"""

import contextlib
import errno
import functools
import io
import os
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from extrap_train.command_line import CommandLine, explain
from extrap_train.command_options import (
    GROUPS,
    CommandOptions,
    choices_of,
    help_text,
    open_own_folders,
)
from extrap_train.config import TASKS, DataPrepConfig, TrainConfig, notes, validate
from extrap_train.errors import InputError
from extrap_train.exits import ends_in_one_line
from extrap_train.store import Outcome
from extrap_train.terminal import terminal

_UNUSABLE = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.ENAMETOOLONG)
"""Errors of a disk that is full, of a path that is closed, and of a name that is too long."""
_NO_FOLDER = (errno.ENOTDIR, errno.ENOENT, errno.EEXIST)
"""Errors on the way to an output that can be no folder."""

TRAIN = CommandOptions(
    "python -m extrap_train", "train", TrainConfig, TASKS, ("experiment", "sweep")
)
PREP = CommandOptions("python -m data_prep", "prep", DataPrepConfig, {})


@functools.cache
def register_schemas() -> None:
    """Make the dataclasses known to Hydra, as `<name>_schema`."""
    store = ConfigStore.instance()
    for options in (TRAIN, PREP):
        store.store(name=f"{options.config_name}_schema", node=options.tree)
    for group, variants in GROUPS.items():
        for variant in variants:
            name = variant.name if len(variants) > 1 else group  # type: ignore[attr-defined]
            store.store(group=group, name=f"{name}_schema", node=variant)


def command(options: CommandOptions, run: Callable[[Any], Outcome | Path | None]) -> None:
    """Compose the command's configuration with the overrides in `sys.argv` and run it.

    `run` may return its result's folder: a sweep takes the numbers of its `summary.json`.

    An option that does not exist, a value of the wrong type, an unknown category and unusable input
    end with one line on stderr and exit status 1.
    """
    with ends_in_one_line():
        line = CommandLine.split(sys.argv[1:])
        if {"--help", "-h"} & set(line.flags):
            print(help_text(options, line.own_folders), end="")
        elif "--version" in line.flags:
            print(f"extrap-train {version('extrap-train')}")
        elif {"-sc", "--shell-completion"} & set(line.flags):
            _complete(options, run)
        else:
            open_own_folders(line.own_folders)
            sys.argv[1:] = line.prepared(options)
            _compose(options, run)


def _compose(options: CommandOptions, run: Callable[[Any], Outcome | Path | None]) -> None:
    register_schemas()

    def checked(config: DictConfig) -> Outcome | Path | None:
        output = "."
        try:
            typed = typed_config(config)
            output = typed.output
            _check_processes(typed)
            _use_threads(typed.threads)
            for note in notes(typed):
                terminal(stderr=True).print(f"note: {note}")
            return run(typed)
        except OSError as error:
            place = Path(str(error.filename or output))
            if error.errno not in _UNUSABLE and not _leads_to_no_folder(error, place, output):
                raise
            raise InputError(
                f"{place}: {error.strerror}; free space, change its rights, give a shorter "
                "run=NAME or choose another output="
            ) from error

    @hydra.main(version_base="1.3", config_path="pkg://conf", config_name=options.config_name)
    def composed(config: DictConfig) -> Outcome | Path | None:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            return checked(config)  # the other jobs of a sweep still run
        with ends_in_one_line():  # before Hydra adds a line of its own
            return checked(config)

    try:
        os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # what is left to go wrong is a bug
        composed()
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise InputError(explain(error, options, sys.argv[1:])) from None


def compose_config(options: CommandOptions, words: Sequence[str]) -> Any:
    """The checked configuration that these words of a command line stand for."""
    register_schemas()
    try:
        with hydra.initialize_config_module("conf", version_base="1.3"):
            prepared = CommandLine.split(words).prepared(options)
            return typed_config(hydra.compose(options.config_name, prepared))
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise InputError(explain(error, options, words)) from None


def _complete(options: CommandOptions, run: Callable[[Any], Outcome | Path | None]) -> None:
    """Hydra's words for the shell, without the schemas, which are not choices."""
    words = io.StringIO()
    with contextlib.redirect_stdout(words):
        _compose(options, run)
    for line in words.getvalue().splitlines():  # one for bash, one per word for fish
        if shown := [word for word in line.split() if not word.endswith("_schema")]:
            print(*shown)


def _leads_to_no_folder(error: OSError, place: Path, output: str) -> bool:
    place, folder = place.absolute(), Path(output).absolute()
    is_on_the_way = place.is_relative_to(folder) or folder.is_relative_to(place)
    return is_on_the_way and error.errno in _NO_FOLDER and not folder.is_dir()


def typed_config(config: DictConfig) -> Any:
    """The dataclass tree of a composed configuration, checked beyond its types."""
    missing = sorted(str(key) for key in OmegaConf.missing_keys(config) if key != "hydra")
    if missing:
        name = missing[0]
        choices = "|".join(choices_of(name)) if name in GROUPS else "VALUE"
        raise InputError(f"{name} is not given: give {name}={choices}")
    typed: Any = OmegaConf.to_object(config)
    validate(typed)
    return typed


def _check_processes(config: Any) -> None:
    """Lightning starts a run's other processes with the whole command: that is the whole sweep."""
    devices = config.trainer.devices if isinstance(config, TrainConfig) else 1
    if devices > 1 and HydraConfig.get().mode == RunMode.MULTIRUN:
        raise InputError(
            f"trainer.devices={devices}: a job of a sweep trains on one device; leave it out or "
            "start the runs one by one"
        )


def _use_threads(threads: int | None) -> None:
    if threads is not None:
        os.environ["OMP_NUM_THREADS"] = str(threads)
        if "numba" not in sys.modules:  # which refuses another number once its threads run
            os.environ["NUMBA_NUM_THREADS"] = str(threads)
