"""One module per `task=`. Tasks call the other packages and contain no algorithms."""

from collections.abc import Callable
from pathlib import Path

from extrap_train.store import Outcome


def task(name: str) -> Callable[..., Outcome | Path | None]:
    """The function of the task called `name`, imported only now: `--help` needs no torch.

    It returns the folder of its result, where there is a `summary.json` in it.
    """
    from importlib import import_module

    run: Callable[..., Outcome | Path | None] = import_module(f"extrap_train.tasks.{name}").run
    return run
