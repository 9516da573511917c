"""The options that a Hydra command has, and the words of a command line put into Hydra's grammar.

Hydra parses values before it knows their options' types: `run=1.10` would become 1.1, and a path
with a blank, an umlaut or `=` a syntax error. A text option holds what was typed, so its value is
quoted here wherever Hydra would read it as anything else.
"""

import difflib
import os
import re
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from importlib.resources import files
from pathlib import Path

from extrap_train import config as schema
from extrap_train.config import Option, options_of
from extrap_train.errors import InputError

_NETWORK_MATCHERS: list[type] = [
    schema.LoftrMatcherConfig,
    schema.AlikedMatcherConfig,
    schema.Mast3rMatcherConfig,
    schema.OwnMatcherConfig,
]
GROUPS: dict[str, list[type]] = {
    "category": [schema.CategoryConfig],
    "data": [
        schema.SyntheticConfig,
        schema.Co3dConfig,
        schema.Uco3dConfig,
        schema.FoldersConfig,
    ],
    "depth": [
        schema.DatasetDepthConfig,
        schema.StereoConfig,
        schema.Mast3rConfig,
        schema.MonocularConfig,
        schema.FilesDepthConfig,
        schema.OwnDepthConfig,
    ],
    "matcher": [schema.FlowMatcherConfig, *_NETWORK_MATCHERS],
    "poses": [schema.SiftPosesConfig, *_NETWORK_MATCHERS],
    "launcher": [schema.LocalConfig, schema.SlurmConfig, schema.RayConfig],
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
    def by_name(self) -> dict[str, Option]:
        """Every option, those of all variants among them."""
        nested = {"depth.matcher": GROUPS["matcher"]} if "depth" in self.groups else {}
        found = dict(options_of(self.tree))
        for group, variants in {**self.groups, **nested}.items():
            for variant in variants:
                found |= options_of(variant, f"{group}.")
        return found

    def find(self, key: str) -> Option | None:
        """The option that a key sets; an entry of a mapping is set by a longer key."""
        if key in self.by_name:
            return self.by_name[key]
        above = (option for name, option in self.by_name.items() if key.startswith(f"{name}."))
        return next((option for option in above if option.kind is dict), None)

    def has_options_below(self, key: str) -> bool:
        """Whether the key names a part of the tree instead of an option."""
        return any(name.startswith(f"{key}.") for name in self.by_name)

    def variants_with(self, key: str) -> list[str]:
        """The choices, as they are typed, that have an option which others of the group lack."""
        group = key.partition(".")[0]
        variants = self.groups.get(group, [])
        found = [v for v in variants if key in options_of(v, f"{group}.")]
        return [f"{group}={v.name}" for v in found] if len(variants) > 1 else []  # type: ignore[attr-defined]

    def suggest(self, key: str) -> str:
        """`; did you mean …?` where an option or a group looks like it."""
        return suggest(key, [*self.by_name, *self.groups, *self.file_groups])


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


def option_rows(tree: type) -> str:
    """A line for every option of a tree, as `--help` shows it."""
    return format_rows(o.row for o in options_of(tree).values() if o.declared.help)


def format_rows(rows: Iterable[tuple[str, str]]) -> str:
    """Two columns."""
    listed = list(rows)
    width = min(_WIDEST, max(len(name) for name, _ in listed))
    return "".join(f"  {name:<{width}}  {meaning}\n" for name, meaning in listed)


def unknown_option(key: str, options: CommandOptions) -> str:
    """What to do instead of giving it: choose what has it, or mend its name."""
    if variants := options.variants_with(key):
        return f"{key} is an option of {' or '.join(variants)}: give that, too, or leave it out"
    return f"there is no option {key}{options.suggest(key)}; see --help"


_FLAGS_WITH_VALUE = (
    *("--config-dir", "-cd", "--config-path", "-cp", "--config-name", "-cn"),
    *("--package", "-p", "--experimental-rerun", "--cfg", "-c", "--info", "-i"),
)
_WORD = re.compile(r"(?P<mark>~|\+{0,2})(?P<key>[^=]*)(?:=(?P<value>.*))?", re.DOTALL)
_SWEEP = re.compile(r"(choice|range|interval|glob|shuffle|sort|tag)\(.*\)", re.DOTALL)
"""What a value of several jobs may be besides values with commas between them."""
_WIDEST = 44
"""Width of the first column of `--help`, where names are that long."""
_NO_VALUE = object()
_NEW_CATEGORY = (
    ". A category of your own is a file MINE/category/NAME.yaml, written like "
    "conf/category/apple.yaml, and --config-dir MINE"
)


@dataclass(frozen=True)
class CommandLine:
    """The words after a command's name."""

    flags: tuple[str, ...]
    """Hydra's own, with their values."""
    overrides: tuple[str, ...]

    @classmethod
    def split(cls, words: Sequence[str]) -> "CommandLine":
        """Tell flags and their values from overrides, in any order."""
        flags, overrides = [], []
        rest = iter(words)
        for word in rest:
            if not word.startswith("-"):
                overrides.append(word)
                continue
            flags.append(word)
            if word in _FLAGS_WITH_VALUE:
                flags += [value for _, value in zip(range(1), rest, strict=False)]
        return cls(tuple(flags), tuple(overrides))

    @property
    def is_sweep(self) -> bool:
        """Whether several jobs are asked for."""
        return bool({"-m", "--multirun"} & set(self.flags))

    @property
    def own_folders(self) -> list[str]:
        """Folders with choices of the user's own."""
        named = ("--config-dir", "-cd")
        apart = [b for a, b in zip(self.flags, self.flags[1:], strict=False) if a in named]
        joined = [flag.partition("=") for flag in self.flags]
        return [*apart, *(folder for name, _, folder in joined if name in named and folder)]

    def prepared(self, options: CommandOptions) -> list[str]:
        """The same words for Hydra; InputError names the first one that cannot be meant."""
        words = [*self.flags, *(self._prepared(word, options) for word in self.overrides)]
        is_of_any = any(f"task={task}" in self.overrides for task in schema.ANY_CATEGORY_TASKS)
        has_category = any(word.startswith("category=") for word in self.overrides)
        return [*words, "category=all"] if is_of_any and not has_category else words

    def _prepared(self, word: str, options: CommandOptions) -> str:
        parts = _WORD.fullmatch(word)
        assert parts is not None  # any text is
        mark, key, value = parts["mark"], parts["key"], parts["value"]
        if key.partition(".")[0].partition("/")[0] == "hydra":
            return word
        group = key.partition("@")[0]
        if group in options.groups or group in options.file_groups:
            return f"{key}={self._choice(group, value, word)}"
        option = options.find(key)
        if option is None and options.has_options_below(key):
            if value in ("null", "{}"):
                return f"{key}={value}"
            raise InputError(f"{word}: {key} has options of its own: give {key}.NAME=VALUE")
        if option is None:
            raise InputError(_unknown(key, value, options))
        if mark == "~" or value is None:
            raise InputError(f"{word}: give a value, as {key}=VALUE")
        if key != option.name:  # an entry of a mapping, new or not
            is_text = option.has_text_entries or _parse(key, value) is _NO_VALUE
            return f"++{key}={self._text(value, key) if is_text else value}"
        if option.kind is str:
            return f"{key}={self._texts(value, option)}"
        if _parse(key, value) is _NO_VALUE:
            raise InputError(f"{key}={value}: {option.must_be}")
        return f"{key}={value}"

    def _choice(self, group: str, value: str | None, word: str) -> str:
        known = choices_of(group, self.own_folders)
        if not value or word.startswith("~"):
            raise InputError(f"{word}: give {group}=NAME; known: {', '.join(known)}")
        if self.is_sweep and _SWEEP.fullmatch(value):
            return value
        for name in value.split(",") if self.is_sweep else [value]:
            if name not in known and name != "null":
                near = suggest(name, known)
                new = _NEW_CATEGORY if group == "category" else ""
                raise InputError(f"{group}={name} is unknown{near}; known: {', '.join(known)}{new}")
        return value

    def _texts(self, value: str, option: Option) -> str:
        """One text, a list of them, or several jobs' values."""
        if self.is_sweep and _SWEEP.fullmatch(value):
            return value
        parts = _split_at_commas(value, lists=option.is_list) if self.is_sweep else [value]
        return ",".join(
            self._list(part, option) if option.is_list else self._text(part, option.name)
            for part in parts
        )

    def _list(self, value: str, option: Option) -> str:
        if not (value.startswith("[") and value.endswith("]")):
            raise InputError(f"{option.name}={value}: {option.must_be}")
        inner = value[1:-1]
        texts = [self._text(t.strip(), option.name) for t in _split_at_commas(inner)]
        return f"[{','.join(texts)}]" if inner.strip() else "[]"

    def _text(self, value: str, key: str) -> str:
        """The value as Hydra reads this text, and no number, list or interpolation, from it."""
        from hydra.core.override_parser.types import Quote, QuotedString

        parsed = _parse(key, value)
        if value == "null" or isinstance(parsed, QuotedString) or not value:
            return value
        if parsed == value and isinstance(parsed, str) and "$" not in value:
            return value
        quote = Quote.single if '"' in value else Quote.double
        return QuotedString(_without_interpolation(value), quote).with_quotes()


def _split_at_commas(text: str, *, lists: bool = False) -> list[str]:
    """The parts between commas that stand in no quotes, nor, of `lists`, in their brackets."""
    parts, depth, quote, start = [], 0, "", 0
    for at, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'" and not text[start:at].strip():
            quote = letter  # one within a word, as in it's, is a letter
        elif lists and letter in "[]":
            depth += 1 if letter == "[" else -1
        elif letter == "," and depth == 0:
            parts.append(text[start:at])
            start = at + 1
    return [*parts, text[start:]]


def _without_interpolation(text: str) -> str:
    r"""`${` as text: OmegaConf writes it `\${`, and each backslash before it twice."""
    return re.sub(r"(\\*)\$\{", lambda found: rf"{found[1] * 2}\${{", text)


def _parse(key: str, value: str) -> object:
    """The value as Hydra's grammar has it; `_NO_VALUE` where it is none."""
    # Slow, and `benchmark list` does without.
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return OverridesParser.create().parse_override(f"{key}={value}")._value
    except HydraException:
        return _NO_VALUE


def _unknown(key: str, value: str | None, options: CommandOptions) -> str:
    if value is not None:
        return unknown_option(key, options)
    groups = [group for group in options.groups if key in choices_of(group)]
    near = f"; did you mean {groups[0]}={key}?" if groups else ""
    return f"{key}: give options as NAME=VALUE{near}"
