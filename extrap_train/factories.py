"""Objects that a YAML names as `factory: package.module.Class`, made with the YAML's options.

A depth source, a matcher, a metric or a benchmark method of your own is such a class: its module
lies in the package, in an installed one, or in a folder given with `--config-dir`.
"""

import importlib
import importlib.util
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from extrap_train.config import check_options
from extrap_train.errors import InputError, did_you_mean


def make_object(
    factory: str, options: Mapping[str, Any], name: str, protocol: type, prefix: str
) -> Any:
    """The object that `factory` makes for the choice called `name`, as `depth=mine`.

    It must have the `protocol`; `prefix` is what its options' names begin with.
    InputError for a factory that cannot be imported, and for options that do not fit; what fails
    within the module keeps its traceback.
    """
    found = import_factory(factory, name)
    made = found(**_typed_options(found, options, name, prefix))
    if not isinstance(made, protocol):
        parts = [part for part in dir(protocol) if not part.startswith("_")]
        lacks = ", ".join(part for part in parts if not hasattr(made, part))
        raise InputError(
            f"{name}: {factory} lacks {lacks}; see {protocol.__module__}.{protocol.__name__}"
        )
    if is_dataclass(made):
        check_options(made, prefix)
    return made


def import_factory(factory: str, name: str) -> Any:
    """The class or function that `factory` names; InputError where it cannot be found."""
    module, _, attribute = factory.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ModuleNotFoundError, AttributeError, ValueError) as error:
        raise InputError(
            f"{name}: factory {factory} cannot be imported ({error}); is its folder given with "
            "--config-dir?"
        ) from None


def module_file(module: str) -> Path | None:
    """Where a module lies, without importing it; None where there is none."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    return Path(spec.origin) if spec and spec.origin else None


def files_of(factory: str, options: Mapping[str, Any]) -> list[Path]:
    """The module that `factory` lies in, and every file that an option names."""
    module = module_file(factory.rpartition(".")[0])
    paths = [Path(value) for value in options.values() if isinstance(value, str) and value]
    return ([module] if module else []) + [path for path in paths if path.is_file()]


def _typed_options(
    factory: Any, options: Mapping[str, Any], name: str, prefix: str
) -> dict[str, Any]:
    """Options as the fields of a dataclass declare them; other factories have none."""
    known = [f.name for f in fields(factory) if f.init] if is_dataclass(factory) else []
    hints, values = get_type_hints(factory), {}
    for option, value in options.items():
        if option not in known:
            hint = did_you_mean(option, known) if known else "it has none"
            raise InputError(f"{name}: there is no option {option}; {hint}")
        kind = TypeAdapter(hints[option], config=ConfigDict(arbitrary_types_allowed=True))
        try:
            values[option] = kind.validate_json(json.dumps(value), strict=True)
        except ValidationError as error:
            reason = error.errors(include_url=False, include_input=False)[0]["msg"]
            raise InputError(f"{prefix}{option}={value}: {reason}") from None
    return values
