"""Checks the shapes of tensors wherever a public function of ours is called.

jaxtyping's own import hook wraps every function, private ones in inner loops too, and takes ten
times as long to import.
"""

import inspect
import sys
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType
from typing import Any

from beartype import beartype
from jaxtyping import jaxtyped

_PACKAGES = {"extrap_train", "data_prep", "benchmarks"}


def check_shapes() -> None:
    """Check every module of ours that is imported from now on."""
    assert not _PACKAGES & set(sys.modules), "imported before their shapes could be checked"
    sys.meta_path.insert(0, _Finder())


class _Finder(MetaPathFinder):
    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name.split(".")[0] not in _PACKAGES:
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and type(spec.loader) is SourceFileLoader:
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


class _Loader(SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)
        for name, member in list(vars(module).items()):
            if getattr(member, "__module__", None) != module.__name__ or name.startswith("_"):
                continue
            if inspect.isfunction(member):
                if _has_shapes(member):
                    setattr(module, name, _checked(member))
            elif inspect.isclass(member):
                _check_class(member)


def _check_class(cls: type) -> None:
    if is_dataclass(cls) and _has_shapes(cls):
        _checked(cls)
    for name, member in list(vars(cls).items()):
        public = name == "__call__" or not name.startswith("_")
        if public and inspect.isfunction(member) and _has_shapes(member):
            setattr(cls, name, _checked(member))


def _checked(member: Any) -> Any:
    return jaxtyped(typechecker=beartype)(member)


def _has_shapes(member: type | Callable) -> bool:
    return any("jaxtyping." in repr(hint) for hint in inspect.get_annotations(member).values())
