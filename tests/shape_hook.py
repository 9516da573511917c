"""Has the shapes of tensors checked in whatever module of ours is imported; itself, it imports
nothing, for the process that only hands tests out to workers.
"""

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType

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
        from shape_checks import check_module

        super().exec_module(module)
        check_module(module)
