"""What the command line can do: each task composes the other rooms and owns no mathematics."""

from collections.abc import Callable
from typing import Any

TASKS = (
    "category",
    "complete",
    "pack",
    "scene",
    "view",
)
"""Known values of `task=`; each is a module here with `run(config)`."""


def task(name: str) -> Callable[[Any], None]:
    """The task's function, imported only now: `--help` needs no torch."""
    from importlib import import_module

    run: Callable[[Any], None] = import_module(f"extrap_train.tasks.{name}").run
    return run
