"""The command line of every Hydra entry point: typed configuration in, one clear line out when it
is wrong; and `--help`.
"""

import contextlib
import errno
import functools
import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException, ValidationError
from yaml import MarkedYAMLError, YAMLError

from extrap_train.command_line import (
    GROUPS,
    CommandLine,
    CommandOptions,
    choices_of,
    format_rows,
    open_own_folders,
    suggest,
    unknown_option,
)
from extrap_train.config import (
    TASKS,
    DataPrepConfig,
    Option,
    TrainConfig,
    notes,
    options_of,
    validate,
)
from extrap_train.errors import InputError, ends_in_one_line, signals_outlive_errors
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
            with signals_outlive_errors():  # other jobs run on after a job's error
                return checked(config)
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


def explain(error: Exception, options: CommandOptions, overrides: Sequence[str]) -> str:
    """What Hydra or OmegaConf has found, in our words where it is about an option or a choice."""
    if isinstance(error, MissingConfigException) and "/" in (error.missing_cfg_file or ""):
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        known = [known for known in error.options or () if not known.endswith("_schema")]
        return f"{group}={name} is unknown{suggest(name, known)}; known: {', '.join(known)}"
    if isinstance(error, YAMLError):
        where = error.problem_mark if isinstance(error, MarkedYAMLError) else None
        place = f"{where.name}, line {where.line + 1}" if where else "a file of options"
        problem = error.problem if isinstance(error, MarkedYAMLError) else error
        return f"{place}: is not valid YAML ({problem}); correct it"
    if "ConfigKeyError" in str(error) and (
        found := re.match(r"In '(.+)': .*\n(?:.*\n)*? *full_key: (\S+)", str(error))
    ):
        return f"{found[1]}.yaml: {unknown_option(found[2], options)}"
    cause = error if isinstance(error, OmegaConfBaseException) else error.__cause__
    if isinstance(cause, OmegaConfBaseException) and cause.full_key:
        key = re.sub(r"\[\d+\]$", "", cause.full_key)
        if isinstance(cause, ValidationError) and key in options.by_name:
            return _wrong_value(key, cause, options, overrides)
        if isinstance(cause, ConfigKeyError | AttributeError):
            return unknown_option(key, options)
    return " ".join(str(error).split("\n")[0].split())


def _wrong_value(
    key: str, cause: ValidationError, options: CommandOptions, overrides: Sequence[str]
) -> str:
    option = options.by_name[key]
    given = next((word for word in overrides if word.startswith(f"{key}=")), key)
    if given == f"{key}=null" and not option.may_be_null:
        return f"{given}: cannot be null"
    value_is_list = given.startswith(f"{key}=[")
    if option.is_list and value_is_list:
        return f"{given}: every value {option.item_must_be}"
    return f"{given}: {option.must_be}"


_HEAD = """\
Usage: {program} category=NAME [GROUP=CHOICE ...] [OPTION=VALUE ...] [FLAG ...]
"""
_TAIL = """\
Text is taken as typed. Quote it for the shell if it holds blanks or signs: 'scene=my scene (1)'.
Two cases need quotes inside as well, as in {quoted}: a value that begins and
ends with quotes of its own, and with -m one that holds a comma.

Flags:
  -m, --multirun      run every combination of values with commas between them: seed=0,1,2
  --config-dir DIR    folder with choices of your own, as DIR/category/vase.yaml
  --version           print the version
  --hydra-help        flags of Hydra, which composes the options
"""


def help_text(options: CommandOptions, own_folders: Sequence[str] = ()) -> str:
    """The whole page."""
    parts = [_HEAD.format(program=options.program)]
    if options.tasks:
        parts.append("Tasks:\n" + format_rows(options.tasks.items()))
    groups = [*options.groups, *options.file_groups]
    choices = [(f"{group}=", " | ".join(choices_of(group, own_folders))) for group in groups]
    choices.append(
        ("matcher@depth.matcher=", "the matcher of depth=monocular and files: depth.matcher.NAME")
    )
    parts.append("Choices:\n" + format_rows(choices))
    for title, found in _sections(options):
        parts.append(f"{title}:\n" + format_rows(option.row for option in found))
    parts.append(_TAIL.format(quoted="""'scene="a,b"'"""))
    return "\n".join(parts)


def _sections(options: CommandOptions) -> Iterator[tuple[str, list[Option]]]:
    """Options of the command itself, of each of its parts, and of each variant of a group."""
    own = options_of(options.tree)
    parts: dict[str, list[Option]] = {}
    for name, option in own.items():
        part = name.rpartition(".")[0]
        if part.partition(".")[0] not in options.groups:
            parts.setdefault(part, []).append(option)
    for part, found in parts.items():
        yield (f"Options of {part}" if part else "Options"), found
    for group, variants in options.groups.items():
        for variant in variants:
            listed = [o for o in options_of(variant, f"{group}.").values() if o.declared.help]
            own_values = f"{group} ({group}= sets values of its own)"
            chosen = f"{group}={variant.name}" if len(variants) > 1 else own_values  # type: ignore[attr-defined]
            if listed:
                yield f"Options of {chosen}", listed
