"""The words of a command line: put into Hydra's grammar, and what is wrong with them, in one line.

Hydra parses values before it knows their options' types: `run=1.10` would become 1.1, and a path
with a blank, an umlaut or `=` a syntax error. A text option holds what was typed, so its value is
quoted here wherever Hydra would read it as anything else.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException, MissingConfigException
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException, ValidationError
from yaml import MarkedYAMLError, YAMLError

from extrap_train.command_options import CommandOptions, choices_of, suggest
from extrap_train.config import Option
from extrap_train.errors import InputError


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
        if isinstance(cause, ValidationError) and key in options.known:
            return _wrong_value(key, cause, options, overrides)
        if isinstance(cause, ConfigKeyError | AttributeError):
            return unknown_option(key, options)
    return " ".join(str(error).split("\n")[0].split())


def unknown_option(key: str, options: CommandOptions) -> str:
    """What to do instead of giving it: choose what has it, or mend its name."""
    if variants := options.variants_with(key):
        return f"{key} is an option of {' or '.join(variants)}: give that, too, or leave it out"
    return f"there is no option {key}{options.suggest(key)}; see --help"


def _wrong_value(
    key: str, cause: ValidationError, options: CommandOptions, overrides: Sequence[str]
) -> str:
    option = options.known[key]
    given = next((word for word in overrides if word.startswith(f"{key}=")), key)
    if given == f"{key}=null" and not option.may_be_null:
        return f"{given}: cannot be null"
    value_is_list = given.startswith(f"{key}=[")
    if option.is_list and value_is_list:
        return f"{given}: every value {option.item_must_be}"
    return f"{given}: {option.must_be}"


_FLAGS_WITH_VALUE = (
    *("--config-dir", "-cd", "--config-path", "-cp", "--config-name", "-cn"),
    *("--package", "-p", "--experimental-rerun", "--cfg", "-c", "--info", "-i"),
)
_WORD = re.compile(r"(?P<mark>~|\+{0,2})(?P<key>[^=]*)(?:=(?P<value>.*))?", re.DOTALL)
_SWEEP = re.compile(r"(choice|range|interval|glob|shuffle|sort|tag)\(.*\)", re.DOTALL)
"""What a value of several jobs may be besides values with commas between them."""


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
        return [*self.flags, *(self._prepared(word, options) for word in self.overrides)]

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
            is_text = option.has_text_entries or _parse(key, value) is None
            return f"++{key}={self._text(value, key) if is_text else value}"
        if option.kind is str:
            return f"{key}={self._texts(value, option)}"
        _require_grammar(key, value, option)
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
                raise InputError(f"{group}={name} is unknown{near}; known: {', '.join(known)}")
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
    """The value as Hydra's grammar has it; None where it is not a value."""
    try:
        return OverridesParser.create().parse_override(f"{key}={value}")._value
    except HydraException:
        return None


def _require_grammar(key: str, value: str, option: Option) -> None:
    try:
        OverridesParser.create().parse_override(f"{key}={value}")
    except HydraException:
        raise InputError(f"{key}={value}: {option.must_be}") from None


def _unknown(key: str, value: str | None, options: CommandOptions) -> str:
    if value is not None:
        return unknown_option(key, options)
    groups = [group for group in options.groups if key in choices_of(group)]
    near = f"; did you mean {groups[0]}={key}?" if groups else ""
    return f"{key}: give options as NAME=VALUE{near}"
