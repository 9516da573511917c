"""Options that are paths, however they are spelled."""

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

_PATHS = ("root", "checkpoint")
_PATHS_OR_NAMES = ("model", "start")
"""What is no path here is the name of weights in the package or in a cache of downloads."""

Options = TypeVar("Options")


def placed(options: Options) -> Options:
    """The same options with paths that lead to where theirs do, whatever they went through.

    `options` are a dataclass of the configuration tree; those below it are placed, too.
    """
    tree: Any = options
    changes: dict[str, Any] = {}
    for field in fields(tree):
        value = getattr(tree, field.name)
        changes[field.name] = (
            placed(value) if is_dataclass(value) else placed_value(field.name, value)
        )
    return replace(tree, **changes)


def placed_value(name: str, value: Any) -> Any:
    """The value of the option called `name` in its group; of a path, the one that it leads to."""
    if not isinstance(value, str) or not value:
        return value
    if name in _PATHS or (name in _PATHS_OR_NAMES and Path(value).exists()):
        return str(Path(value).resolve())
    return value
