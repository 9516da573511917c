"""A method from its YAML."""

import importlib
from dataclasses import fields, is_dataclass
from typing import Any

from benchmarks.methods.base import Method
from extrap_train.config import MethodConfig
from extrap_train.errors import InputError, did_you_mean


def build_method(config: MethodConfig) -> Method:
    """The object that `factory` names, with its options; raises InputError for what does not fit.

    The file's own ImportError keeps its traceback only where the file itself is found.
    """
    module_name, _, name = config.factory.rpartition(".")
    try:
        factory = getattr(importlib.import_module(module_name), name)
    except (ModuleNotFoundError, AttributeError, ValueError) as error:
        raise InputError(
            f"method {config.name}: factory {config.factory} cannot be imported ({error}); is its "
            "folder given with --config-dir?"
        ) from None
    _check_options(config, factory)
    method = factory(**config.options)
    if not isinstance(method, Method):
        raise InputError(
            f"method {config.name}: {config.factory} has no weight_files() and synthesize(); see "
            "benchmarks/methods/base.py"
        )
    return method


def _check_options(config: MethodConfig, factory: Any) -> None:
    known = [f.name for f in fields(factory) if f.init] if is_dataclass(factory) else []
    for option in config.options:
        if option not in known:
            hint = did_you_mean(option, known) if known else "it has none"
            raise InputError(f"method {config.name}: there is no option {option}; {hint}")
