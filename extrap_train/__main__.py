"""`python -m extrap_train`: configuration to task, nothing else."""

from pathlib import Path

from extrap_train.cli import TRAIN, command
from extrap_train.config import TrainConfig
from extrap_train.store.outcome import Outcome
from extrap_train.tasks import task


def _run(config: TrainConfig) -> Outcome | Path | None:
    return task(config.task)(config)


def main() -> None:
    """Entry point of `extrap-train`."""
    command(TRAIN, _run)


if __name__ == "__main__":
    main()
