"""Imports point one way, within `extrap_train` as between the three top-level packages."""

import ast
import functools
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

_ROOT = Path(__file__).parents[1]
_ORDER = (
    "extrap_train.errors",
    "extrap_train.views",
    "extrap_train.terminal",
    "extrap_train.store",
    "extrap_train.config",
    "extrap_train.factories",
    "extrap_train.device",
    "extrap_train.geometry",
    "extrap_train.weight_files",
    "extrap_train.jobs",
    "extrap_train.processes",
    "extrap_train.metrics",
    "extrap_train.depth.mast3r.network",
    "extrap_train.matching",
    "extrap_train.data.paths",
    "extrap_train.data.image_files",
    "extrap_train.depth",
    "extrap_train.data",
    "extrap_train.figures",
    "extrap_train.diffusion",
    "extrap_train.reconstruction",
    "extrap_train.gaussians",
    "extrap_train.runs",
    "extrap_train.tasks",
    "extrap_train.sweep",
    "extrap_train.command_line",
    "extrap_train.cli",
    "data_prep",
    "benchmarks",
    "extrap_train.api",
)
"""Every package imports only from those before it, so there is no cycle."""
_PACKAGES = ("extrap_train", "data_prep", "benchmarks")
_FILES = sorted(path for package in _PACKAGES for path in (_ROOT / package).rglob("*.py"))


def _package_of(module: str) -> str | None:
    return next((r for r in _ORDER if module == r or module.startswith(f"{r}.")), None)


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
            of_package = node.module in _PACKAGES  # `from extrap_train import views`: a package
            names += [f"{node.module}.{alias.name}" for alias in node.names if of_package]
            names += [] if of_package else [str(node.module)]
    return names


def test_imports_point_one_way() -> None:
    """At a module's top or in a function; only `__main__` and the lazy `extrap_train` compose."""
    wrong = []
    for path in _FILES:
        module = _module(path)
        if module.endswith("__main__") or module == "extrap_train":
            continue
        here = _package_of(module)
        if here is None:
            wrong.append(f"{module} is in no package of the order")
            continue
        below = _ORDER[: _ORDER.index(here) + 1]
        wrong += [
            f"{module} imports {name}"
            for name in _imports(path)
            if name.split(".")[0] in _PACKAGES and _package_of(name) not in below
        ]
    assert not wrong


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
        # an extra that is not installed: mlflow is in mlflow-skinny
        and not (name not in distributions and any(d.startswith(f"{name}-") for d in declared))
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
