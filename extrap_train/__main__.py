"""`python -m extrap_train`: configuration to task, nothing else.

Preparation builds on this package, so the tasks that train or validate on pairs are given it here.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from extrap_train.cli import TRAIN, command
from extrap_train.config import PAIR_TASKS, TrainConfig
from extrap_train.store import Outcome
from extrap_train.tasks import task

if TYPE_CHECKING:
    from extrap_train.data.prepared import PreparedData


def _run(config: TrainConfig) -> Outcome | Path | None:
    run = task(config.task)
    return run(config, _prepare) if config.task in PAIR_TASKS else run(config)


def _prepare(config: TrainConfig) -> "list[PreparedData]":
    from data_prep.category_pairs import prepare_for_training

    return prepare_for_training(config)


def main() -> None:
    """Entry point of `extrap-train`."""
    command(TRAIN, _run)


if __name__ == "__main__":
    main()
