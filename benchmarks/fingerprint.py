"""Hashes of what decides a result beside its options: code and weights.

A method's code is its own file and every file that it imports of this project, or of the folder
that its own import begins at (`--config-dir`), so that a change of a report's style leaves every
finished cell as it is. What is installed is no file of one's own.
"""

import ast
import hashlib
import importlib.util
import sysconfig
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path

from extrap_train.errors import InputError

_OURS = ("benchmarks", "data_prep", "extrap_train")
_INSTALLED = ("site-packages", "dist-packages")


def code_hash(modules: Iterable[str]) -> str:
    """SHA-256 over the sources of some modules and of all that they import of these packages, and
    of what lies beside them.
    """
    found: dict[str, Path] = {}
    waiting = list(modules)
    packages = {*_OURS, *map(_top, waiting)}
    roots = [root for name in waiting if _top(name) not in _OURS for root in _import_roots(name)]
    while waiting:
        name = waiting.pop()
        if name in found or not (_top(name) in packages or _lies_in(_top(name), roots)):
            continue
        source = _source(name)
        if source is not None:
            found[name] = source
            waiting += [*_imports(source, _package(name, source)), *_parents(name)]
    digest = hashlib.sha256()
    for name in sorted(found):
        digest.update(f"{name}\0".encode())
        digest.update(found[name].read_bytes())
    return digest.hexdigest()


def weights_hash(files: Sequence[Path]) -> str:
    """SHA-256 over the contents of weight files, in their order; their place does not matter."""
    digest = hashlib.sha256()
    for file in files:
        try:
            stamp = file.stat()
            digest.update(_file_hash(file, stamp.st_size, stamp.st_mtime_ns).encode())
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from None
    return digest.hexdigest()


@lru_cache(256)
def _file_hash(file: Path, size: int, mtime_ns: int) -> str:
    """Size and time are there to notice a file that has changed since it was hashed."""
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


@lru_cache(4096)
def _source(module: str) -> Path | None:
    """The file of a module; None where there is no module of that name."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return None
    return Path(spec.origin)


def _top(module: str) -> str:
    return module.partition(".")[0]


def _import_roots(module: str) -> list[Path]:
    """The folder on the import path that a module is found in, as in `root/package/module.py`."""
    source = _source(module)
    if source is None:
        return []
    depth = module.count(".") + (source.name == "__init__.py")
    return [source.resolve().parents[depth]]


def _lies_in(package: str, roots: Sequence[Path]) -> bool:
    """Whether a top-level module or package is in or under one of the folders, not installed."""
    return any(
        place.is_relative_to(root) and not _is_installed(place)
        for root in roots
        for place in _places(package)
    )


def _is_installed(place: Path) -> bool:
    library = Path(sysconfig.get_path("stdlib")).resolve()
    return place.is_relative_to(library) or any(part in _INSTALLED for part in place.parts)


@lru_cache(4096)
def _places(package: str) -> tuple[Path, ...]:
    """Where a top-level module, or a package with or without `__init__.py`, lies."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return ()
    if spec is None:
        return ()
    folders = spec.submodule_search_locations
    places = [spec.origin or ""] if folders is None else folders
    return tuple(Path(place).resolve() for place in places if place)


def _package(module: str, source: Path) -> str:
    """What a module's relative imports are relative to."""
    return module if source.name == "__init__.py" else module.rpartition(".")[0]


@lru_cache(4096)
def _imports(source: Path, package: str) -> tuple[str, ...]:
    return tuple(_imported(ast.parse(source.read_bytes()), package))


def _imported(tree: ast.Module, package: str) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            name = "." * node.level + (node.module or "")
            module = importlib.util.resolve_name(name, package)
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)


def _parents(module: str) -> list[str]:
    parts = module.split(".")
    return [".".join(parts[:i]) for i in range(1, len(parts))]
