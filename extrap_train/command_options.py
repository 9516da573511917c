"""Everything that a Hydra command can be told: its options, its groups and what they choose."""

import difflib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from importlib.resources import files
from pathlib import Path

from extrap_train import config as schema
from extrap_train.config import Option, options_of

GROUPS: dict[str, list[type]] = {
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
"""Variants of each group; one alone has files that differ in values only."""


@dataclass(frozen=True)
class CommandOptions:
    """What one command can be told."""

    program: str
    """As it is started."""
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


def suggest(given: str, known: Collection[str]) -> str:
    """`; did you mean …?` with the known name that looks most like the given one."""
    near = difflib.get_close_matches(given, [name for name in known if name != given], n=1)
    return f"; did you mean {near[0]}?" if near else ""
