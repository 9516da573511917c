"""Imports point one way: geometry and views know nothing of depth and data, and those nothing of
diffusion.
"""

import ast
import functools
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

_ROOT = Path(__file__).parents[1]
_RANK = {
    "extrap_train.errors": 0,
    "extrap_train.config": 1,
    "extrap_train.device": 1,
    "extrap_train.store": 1,
    "extrap_train.weight_files": 1,
    "extrap_train.views": 1,
    "extrap_train.jobs": 2,
    "extrap_train.geometry": 2,
    "extrap_train.depth": 3,
    "extrap_train.matching": 3,
    "extrap_train.data": 3,
    "extrap_train.metrics": 3,
    "extrap_train.pictures": 4,
    "extrap_train.processes": 4,
    "extrap_train.gaussians": 5,
    "extrap_train.diffusion": 5,
    "extrap_train.terminal": 1,
    "extrap_train.exits": 1,
    "extrap_train.command_options": 2,
    "extrap_train.option_errors": 3,
    "extrap_train.help_text": 3,
    "extrap_train.overrides": 4,
    "extrap_train.text_values": 2,
    "extrap_train.runs": 5,
    "extrap_train.sweep": 5,
    "extrap_train.sweep_seeds": 2,
    "extrap_train.reconstruction": 6,
    "data_prep": 7,
    "benchmarks": 7,
    "extrap_train.tasks": 8,
    "extrap_train.cli": 9,
}
_ROOMS = sorted(_RANK, key=len, reverse=True)
_FILES = sorted(
    path
    for room in ("extrap_train", "data_prep", "benchmarks")
    for path in (_ROOT / room).rglob("*.py")
)


def _room(module: str) -> str | None:
    return next((r for r in _ROOMS if module == r or module.startswith(f"{r}.")), None)


def _module(path: Path) -> str:
    parts = path.relative_to(_ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def _imports(path: Path) -> list[str]:
    tree = ast.parse(path.read_text())
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.append(node.module or "")
    return names


def test_every_file_is_in_a_room() -> None:
    homeless = [
        module
        for path in _FILES
        if not (module := _module(path)).endswith("__main__")
        and module != "extrap_train"
        and _room(module) is None
    ]
    assert not homeless


def test_imports_point_one_way() -> None:
    upward = [
        f"{module} imports {name}"
        for path in _FILES
        if not (module := _module(path)).endswith("__main__") and (here := _room(module))
        for name in _imports(path)
        if (there := _room(name)) and _RANK[there] > _RANK[here]
    ]
    assert not upward


def test_geometry_knows_neither_lightning_nor_hydra() -> None:
    known = [
        f"{module} imports {name}"
        for path in _FILES
        if (module := _module(path)).startswith("extrap_train.geometry")
        for name in _imports(path)
        if name.split(".")[0] in {"lightning", "hydra", "omegaconf"}
    ]
    assert not known


def test_what_is_imported_is_declared() -> None:
    """Whatever another package happens to bring along is not ours to rely on."""
    project = tomllib.loads((_ROOT / "pyproject.toml").read_text())["project"]
    declared = {
        _normalised(re.split(r"[^\w.-]", line)[0])
        for lines in (project["dependencies"], *project["optional-dependencies"].values())
        for line in lines
    }
    imported = {name.split(".")[0] for path in _FILES for name in _imports(path)}
    ours = {"extrap_train", "data_prep", "benchmarks", "conf"}
    distributions = packages_distributions()
    undeclared = {
        name
        for name in imported - ours - set(sys.stdlib_module_names)
        if not declared & {_normalised(d) for d in distributions.get(name, [name])}
    }
    assert not undeclared


def _normalised(distribution: str) -> str:
    return re.sub(r"[-_.]+", "-", distribution).lower()


def test_every_file_is_short() -> None:
    long = [str(p) for p in _FILES if len(p.read_text().splitlines()) > 350]
    assert not long


def test_every_command_speaks_through_one_console() -> None:
    """A console of its own would take brackets in a path for markup, and fold it."""
    own = [str(p) for p in _FILES if p.name != "terminal.py" and "Console(" in p.read_text()]
    assert not own
