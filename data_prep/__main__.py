"""`python -m data_prep`: sequences in, pair data set and report out."""

from pathlib import Path

from extrap_train.cli import PREP, command
from extrap_train.config import DataPrepConfig


def _run(config: DataPrepConfig) -> None:
    # Heavy imports wait until the options are known to be right.
    from data_prep.category_pairs import check_members, prepare_category
    from data_prep.prep_report import write_report
    from extrap_train.terminal import terminal

    check_members(config.category, config.data)
    for member in config.category.members:
        prepared = prepare_category(
            member,
            config.data,
            config.depth,
            config.prep,
            output=Path(config.output),
            workers=config.workers or config.threads,
            matcher=config.matcher,
            launcher=config.launcher,
            retry=True,
        )
        write_report(prepared, terminal())


def main() -> None:
    """Entry point of `data-prep`."""
    command(PREP, _run)


if __name__ == "__main__":
    main()
