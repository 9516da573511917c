"""Hashes of what decides a result beside its options: code and weights.

A method's code is its own file and every file of this project, or beside it, that it imports, so
that a change of a report's style leaves every finished cell as it is.
"""

import ast
import hashlib
import importlib.util
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path

from extrap_train.errors import InputError

_OURS = ("benchmarks", "data_prep", "extrap_train")


def code_hash(modules: Iterable[str]) -> str:
    """SHA-256 over the sources of some modules and of all that they import of these packages."""
    found: dict[str, Path] = {}
    waiting = list(modules)
    packages = {*_OURS, *(name.partition(".")[0] for name in waiting)}
    while waiting:
        name = waiting.pop()
        if name in found or name.partition(".")[0] not in packages:
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
