"""Whether the rows of a table can be meant, before anything is prepared for them."""

import importlib
from collections.abc import Iterable
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from benchmarks.protocol import digest
from extrap_train.config import MethodConfig
from extrap_train.errors import InputError


def require_options_fit(method: MethodConfig) -> None:
    """InputError for an option that is not of the kind that the method's class declares.

    Names that it does not know, and a class that cannot be imported, are for `build_method` to say.
    """
    module, _, name = method.factory.rpartition(".")
    try:
        declared = get_type_hints(getattr(importlib.import_module(module), name))
    except (ModuleNotFoundError, AttributeError, ValueError):
        return
    for option, value in method.options.items():
        kind = declared.get(option, Any)
        if not _fits(value, kind):
            words = kind.__name__ if isinstance(kind, type) else str(kind).replace("typing.", "")
            raise InputError(f"options.{method.name}.{option}={value}: must be of type {words}")


def _fits(value: Any, kind: Any) -> bool:
    """Kinds that are declared in other words than these are for the method to judge."""
    if get_origin(kind) in (Union, UnionType):
        return any(_fits(value, one) for one in get_args(kind))
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, kind) if kind in (str, bool, type(None)) else True


def require_different(methods: Iterable[MethodConfig]) -> None:
    """InputError for two methods that are the same: one cell cannot be two rows."""
    known: dict[str, str] = {}
    for method in methods:
        same = known.setdefault(method_hash(method), method.name)
        if same != method.name:
            raise InputError(
                f"methods {same} and {method.name} are the same, with the same options; leave one "
                "out: methods=[...]"
            )


def method_hash(method: MethodConfig) -> str:
    """Of what a method's YAML and the table's options say."""
    return digest([method.factory, method.options])
