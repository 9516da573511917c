"""Checks the shapes of tensors wherever a public function of ours is called.

jaxtyping's own import hook wraps every function, private ones in inner loops too, and takes ten
times as long to import. Within a test, arguments of the same types and shapes are checked once: a
fit calls the same functions a thousand times.
"""

import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import wraps
from types import ModuleType
from typing import Any

import numpy as np
from beartype import beartype
from jaxtyping import jaxtyped
from torch import Tensor

_SEEN: set[tuple[Any, ...]] = set()
"""Functions with the types and shapes of arguments that they have passed with."""


def forget_checks() -> None:
    """Check everything again, so that a test fails whichever ran before it."""
    _SEEN.clear()


def check_module(module: ModuleType) -> None:
    """Replace its public functions and methods by ones that check what they are called with."""
    for name, member in list(vars(module).items()):
        if getattr(member, "__module__", None) != module.__name__ or name.startswith("_"):
            continue
        if inspect.isfunction(member):
            if _has_shapes(member):
                setattr(module, name, _checked(member))
        elif inspect.isclass(member):
            _check_class(member)


def _check_class(cls: Any) -> None:
    if is_dataclass(cls) and _has_shapes(cls):
        plain = cls.__init__
        jaxtyped(typechecker=beartype)(cls)
        cls.__init__ = _once_checked(plain, cls.__init__)
    for name, member in list(vars(cls).items()):
        public = name == "__call__" or not name.startswith("_")
        if public and inspect.isfunction(member) and _has_shapes(member):
            setattr(cls, name, _checked(member))


def _checked(function: Callable) -> Callable:
    return _once_checked(function, jaxtyped(typechecker=beartype)(function))


def _once_checked(plain: Callable, checked: Callable) -> Callable:
    """`checked` for arguments that this test has not yet called it with, else `plain`."""

    @wraps(plain)
    def call(*arguments: Any, **options: Any) -> Any:
        kinds = (plain, *map(_kind, arguments), *options, *map(_kind, options.values()))
        if kinds in _SEEN:
            return plain(*arguments, **options)
        result = checked(*arguments, **options)
        _SEEN.add(kinds)
        return result

    return call


def _kind(value: Any) -> tuple[Any, ...]:
    if isinstance(value, Tensor | np.ndarray):
        return type(value), value.shape, value.dtype
    if isinstance(value, list | tuple):
        return type(value), len(value), *map(_kind, value[:8])
    return (type(value),)


def _has_shapes(member: type | Callable) -> bool:
    return any("jaxtyping." in repr(hint) for hint in inspect.get_annotations(member).values())
