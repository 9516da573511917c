"""The options of a Hydra command, and its `--help`."""

import difflib
import os
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

from extrap_train import config as schema
from extrap_train.config import MISSING, Option, options_of
from extrap_train.errors import InputError

GROUPS: dict[str, list[type]] = {
    "category": [schema.CategoryConfig],
    "data": [schema.SyntheticConfig, schema.Co3dConfig],
    "depth": [
        schema.DatasetDepthConfig,
        schema.StereoConfig,
        schema.Mast3rConfig,
        schema.MonocularConfig,
        schema.OwnDepthConfig,
    ],
    "matcher": [
        schema.FlowMatcherConfig,
        schema.LoftrMatcherConfig,
        schema.AlikedMatcherConfig,
        schema.OwnMatcherConfig,
    ],
    "launcher": [schema.LocalConfig, schema.SlurmConfig],
    "model": [schema.ModelConfig],
    "logger": [schema.LoggerConfig],
}
"""Variants of each group; one alone has files that differ in values only."""


@dataclass(frozen=True)
class CommandOptions:
    """The options of one command."""

    program: str
    """How the command is started."""
    config_name: str
    """Its file in `conf/`."""
    tree: type
    tasks: Mapping[str, str]
    """What each value of `task=` does; empty for a command of one task."""
    file_groups: tuple[str, ...] = ()
    """Groups of files that set options of any kind."""

    @cached_property
    def groups(self) -> dict[str, list[type]]:
        """Those of `GROUPS` that its tree has."""
        own = {each.name for each in fields(self.tree)}
        return {group: variants for group, variants in GROUPS.items() if group in own}

    @cached_property
    def known(self) -> dict[str, Option]:
        """Every option, those of all variants among them."""
        nested = {"depth.matcher": GROUPS["matcher"]} if "depth" in self.groups else {}
        found = dict(options_of(self.tree))
        for group, variants in {**self.groups, **nested}.items():
            for variant in variants:
                found |= options_of(variant, f"{group}.")
        return found

    def find(self, key: str) -> Option | None:
        """The option that a key sets; an entry of a mapping is set by a longer key."""
        if key in self.known:
            return self.known[key]
        above = (option for name, option in self.known.items() if key.startswith(f"{name}."))
        return next((option for option in above if option.kind is dict), None)

    def has_options_below(self, key: str) -> bool:
        """Whether the key names a part of the tree instead of an option."""
        return any(name.startswith(f"{key}.") for name in self.known)

    def variants_with(self, key: str) -> list[str]:
        """The choices, as they are typed, that have an option which others of the group lack."""
        group = key.partition(".")[0]
        variants = self.groups.get(group, [])
        found = [v for v in variants if key in options_of(v, f"{group}.")]
        return [f"{group}={v.name}" for v in found] if len(variants) > 1 else []  # type: ignore[attr-defined]

    def suggest(self, key: str) -> str:
        """`; did you mean …?` where an option or a group looks like it."""
        return suggest(key, [*self.known, *self.groups, *self.file_groups])


def choices_of(group: str, own_folders: Sequence[str] = ()) -> list[str]:
    """Names of the files of a group, in the package and in folders of the user's own."""
    places = [Path(str(files("conf"))), *map(Path, own_folders)]
    found = ((place / group, file) for place in places for file in (place / group).rglob("*.yaml"))
    return sorted({file.relative_to(folder).with_suffix("").as_posix() for folder, file in found})


def open_own_folders(names: Sequence[str]) -> list[str]:
    """Absolute paths of the folders given with `--config-dir`; their modules can then be imported.

    Worker processes import from them, too. InputError for one that is not there.
    """
    folders = [str(Path(name).resolve()) for name in names]
    for name, folder in zip(names, folders, strict=True):
        if not Path(folder).is_dir():
            raise InputError(f"--config-dir {name}: no such folder")
        sys.path.insert(0, folder)
    if folders:
        paths = [*folders, *filter(None, [os.environ.get("PYTHONPATH")])]
        os.environ["PYTHONPATH"] = os.pathsep.join(paths)
    return folders


def suggest(given: str, known: Collection[str]) -> str:
    """`; did you mean …?` with the known name that looks most like the given one."""
    near = difflib.get_close_matches(given, [name for name in known if name != given], n=1)
    return f"; did you mean {near[0]}?" if near else ""


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


_WIDEST = 44


def help_text(options: CommandOptions, own_folders: Sequence[str] = ()) -> str:
    """The whole page."""
    parts = [_HEAD.format(program=options.program)]
    if options.tasks:
        parts.append("Tasks:\n" + _rows(options.tasks.items()))
    groups = [*options.groups, *options.file_groups]
    choices = [(f"{group}=", " | ".join(choices_of(group, own_folders))) for group in groups]
    choices.append(("matcher@depth.matcher=", "the matcher of depth=monocular: depth.matcher.NAME"))
    parts.append("Choices:\n" + _rows(choices))
    for title, found in _sections(options):
        parts.append(f"{title}:\n" + _rows(map(_row, found)))
    parts.append(_TAIL.format(quoted="""'scene="a,b"'"""))
    return "\n".join(parts)


def option_rows(tree: type) -> str:
    """A line for every option of a tree."""
    return _rows(_row(option) for option in options_of(tree).values() if option.declared.help)


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


def _row(option: Option) -> tuple[str, str]:
    values = " | ".join(option.declared.known) or option.range
    limits = ", ".join(filter(None, [option.declared.unit, values]))
    return f"{option.name}={_shown(option.default)}", option.declared.help + (
        f" ({limits})" if limits else ""
    )


def _shown(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return str(value).lower().replace("none", "null")
    if isinstance(value, list):
        return f"[{','.join(map(_shown, value))}]"
    return "" if value == MISSING else f"{value}"


def _rows(rows: Iterable[tuple[str, str]]) -> str:
    listed = list(rows)
    width = min(_WIDEST, max(len(name) for name, _ in listed))
    return "".join(f"  {name:<{width}}  {meaning}\n" for name, meaning in listed)
