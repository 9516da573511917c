"""`python -m data_prep`: sequences in, pair data set and report out."""

from extrap_train.cli import PREP, command
from extrap_train.config import DataPrepConfig


def _run(config: DataPrepConfig) -> None:
    # Heavy imports wait until the options are known to be right.
    from data_prep.category_pairs import prepare_members
    from data_prep.frame_features import encode_members
    from data_prep.prep_report import write_report
    from extrap_train.data.shards import write_shards
    from extrap_train.terminal import terminal

    workers = config.workers or config.threads
    made = [*prepare_members(config, workers=workers, launcher=config.launcher, retry=True)]
    for prepared in made:
        write_report(prepared, terminal())
    if config.model is not None:
        encode_members(made, config.model)
    if config.shards is not None:
        for category, prepared in zip(config.category.members, made, strict=True):
            write_shards(prepared, category, config.shards)


def main() -> None:
    """Entry point of `data-prep`."""
    command(PREP, _run)


if __name__ == "__main__":
    main()
