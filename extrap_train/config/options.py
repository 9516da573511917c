"""Options declare themselves: help, unit and range stand with the field."""

import copy
import math
from collections.abc import Iterator, Mapping
from dataclasses import MISSING as NO_DEFAULT
from dataclasses import Field, dataclass, field, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from extrap_train.errors import InputError

MISSING: Any = "???"  # OmegaConf's mark for "must be given"
_PATHS = ("root", "checkpoint", "depth_network", "folder")
_PATHS_OR_NAMES = ("model", "start")
"""What is not a path here is the name of weights in the package or in a cache of downloads."""
PACKAGED_MODELS = Path(__file__).parents[1] / "weights"
"""Folder of the models that come with the package."""
MODEL_CONFIG = "extrapolation_model.json"
"""What makes a folder a model of this project: its configuration."""
Options = TypeVar("Options")
_KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}


@dataclass(frozen=True)
class Declared:
    """What a field says of itself."""

    help: str = ""
    unit: str = ""
    low: int | float = -math.inf
    high: int | float = math.inf
    choices: tuple[str, ...] = ()
    """The words that a text, or a key of a mapping, may be; empty where any is right."""
    is_set: bool = False
    """Whether a list must not hold a value twice."""


@dataclass(frozen=True)
class Option:
    """One option of a command."""

    name: str
    """Dotted, as it is typed."""
    kind: type
    """`int`, `float`, `bool`, `str`, or `dict`; of a list that of its items."""
    is_list: bool
    may_be_null: bool
    default: Any
    declared: Declared
    has_text_entries: bool = False
    """Whether the values of a mapping are texts."""

    @property
    def must_be(self) -> str:
        """What a value of it is."""
        if self.is_list:
            return "must be a list, as [a,b]" if self.kind is str else "must be a list, as [1,2]"
        return self.item_must_be

    @property
    def item_must_be(self) -> str:
        """What a value of it is, or of a list one of its values."""
        if self.declared.choices:
            return f"must be one of {', '.join(self.declared.choices)}"
        return f"must be {_KINDS.get(self.kind, 'a mapping, as {name: value}')}"

    @property
    def range(self) -> str:
        """The values that a number may take; empty where that is not limited."""
        low, high = self.declared.low, self.declared.high
        if math.isfinite(low) and math.isfinite(high):
            return f"from {_plain(low)} to {_plain(high)}"
        return f"at least {_plain(low)}" if math.isfinite(low) else ""

    @property
    def row(self) -> tuple[str, str]:
        """Its line in a `--help`: name and default; meaning, unit and range."""
        limits = [self.declared.unit, " | ".join(self.declared.choices) or self.range]
        said = ", ".join(filter(None, limits))
        return f"{self.name}={_shown(self.default)}", self.declared.help + (
            f" ({said})" if said else ""
        )

    def check(self, value: Any) -> None:
        """InputError where a value is out of the range, not among the known words or repeated."""
        items = [*value] if isinstance(value, list | tuple | dict) else [value]
        for index, item in enumerate(items):
            if self.declared.is_set and item in items[:index]:
                raise InputError(f"{self.name}: {item} is listed twice; leave one out")
            choices = self.declared.choices
            if isinstance(item, str) and choices and item not in choices:
                raise InputError(f"{self.name}={item} is unknown; known: {', '.join(choices)}")
            is_number = isinstance(item, int | float)
            if is_number and not self.declared.low <= item <= self.declared.high:
                raise InputError(f"{self.name}={value}: must be {self.range}")


def option(
    default: Any,
    meaning: str,
    *,
    unit: str = "",
    low: int | float = -math.inf,
    high: int | float = math.inf,
    choices: tuple[str, ...] = (),
    is_set: bool = False,
) -> Any:
    """A dataclass field that is an option, with its default."""
    metadata = {"option": Declared(meaning, unit, low, high, choices, is_set)}
    if isinstance(default, list | dict):
        return field(default_factory=lambda: copy.copy(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def unset(tree: type, name: str) -> Any:
    """An option that means what `tree`'s of that name means, and is null unless it is given."""
    return field(default=None, metadata=tree.__dataclass_fields__[name].metadata)  # type: ignore[attr-defined]


@cache
def options_of(tree: type, prefix: str = "") -> Mapping[str, Option]:
    """Every option of a tree of dataclasses, by its dotted name."""
    return {found.name: found for found in _walk(tree, prefix)}


def check_options(tree: Any, prefix: str = "") -> None:
    """InputError for the first value of an instance that its field's declaration does not allow."""
    for name, value in vars(tree).items():
        if is_dataclass(value):
            check_options(value, f"{prefix}{name}.")
        elif (found := options_of(tree.__class__, prefix).get(f"{prefix}{name}")) is not None:
            found.check(value)


def _walk(tree: type, prefix: str) -> Iterator[Option]:
    hints = get_type_hints(tree)
    for each in fields(tree):
        hint, may_be_null = _without_null(hints[each.name])
        name = f"{prefix}{each.name}"
        if is_dataclass(hint):
            yield from _walk(hint, f"{name}.")  # type: ignore[arg-type]
            continue
        is_list = get_origin(hint) is list
        kind = get_args(hint)[0] if is_list else get_origin(hint) or hint
        declared = _declared(tree, each.name)
        texts = kind is dict and get_args(hint)[1:] == (str,)
        yield Option(name, kind, is_list, may_be_null, _default(each), declared, texts)


def _declared(tree: type, name: str) -> Declared:
    """A subclass may give an inherited option another default without declaring it again."""
    for owner in tree.__mro__:
        own = vars(owner).get("__dataclass_fields__", {}).get(name)
        if own is not None and "option" in own.metadata:
            found: Declared = own.metadata["option"]
            return found
    return Declared()


def _shown(value: Any) -> str:
    """A default as it is typed."""
    if value is None or isinstance(value, bool):
        return str(value).lower().replace("none", "null")
    if isinstance(value, list):
        return f"[{','.join(map(_shown, value))}]"
    return "" if value == MISSING else f"{value}"


def _plain(number: int | float) -> str:
    return str(int(number)) if number == int(number) else f"{number:g}"


def _without_null(hint: Any) -> tuple[Any, bool]:
    if get_origin(hint) not in (UnionType, Union):
        return hint, False
    kinds = [kind for kind in get_args(hint) if kind is not type(None)]
    return kinds[0], True


def _default(each: "Field[Any]") -> Any:
    if each.default_factory is not NO_DEFAULT:
        return each.default_factory()
    return MISSING if each.default is NO_DEFAULT else each.default


def dotted(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested mapping as one of dotted keys."""
    items: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            items |= dotted(value, f"{prefix}{key}.")
        else:
            items[prefix + key] = value
    return items


def resolve_paths(options: Options) -> Options:
    """The same options with paths that lead to where theirs do, whatever they went through.

    `options` are a dataclass of the configuration tree; those below it are resolved, too.
    """
    tree: Any = options
    changes: dict[str, Any] = {}
    for each in fields(tree):
        value = getattr(tree, each.name)
        is_part = is_dataclass(value)
        changes[each.name] = resolve_paths(value) if is_part else resolve_path(each.name, value)
    return replace(tree, **changes)


def packaged_names() -> list[str]:
    """All models that come with the package.

    Such a name means that model wherever weights are named; a folder called so is `./NAME`.
    """
    return sorted(path.parent.name for path in PACKAGED_MODELS.glob(f"*/{MODEL_CONFIG}"))


def resolve_path(name: str, value: Any) -> Any:
    """The value of the option called `name` in its group; of a path, the one that it leads to."""
    if not isinstance(value, str) or not value:
        return value
    is_path = name in _PATHS
    if name in _PATHS_OR_NAMES:
        is_path = value not in packaged_names() and Path(value).exists()
    if is_path:
        return str(Path(value).resolve())
    return value
