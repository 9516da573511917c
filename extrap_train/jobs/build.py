"""A launcher from its options."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path

from extrap_train.config import LauncherConfig, LocalConfig, SlurmConfig
from extrap_train.errors import InputError
from extrap_train.jobs import Died, Item, Launcher, Result
from extrap_train.jobs.local import LocalLauncher
from extrap_train.jobs.slurm import slurm_launcher


class _WhenNeeded:
    """A cluster's launcher, which is asked for with the first jobs: often there are none."""

    def __init__(self, config: SlurmConfig, folder: Path) -> None:
        self.config, self.folder = config, folder

    def run(
        self, job: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Died]]:
        """See `Launcher`."""
        yield from self._opened.run(job, items)

    @cached_property
    def _opened(self) -> Launcher:
        return slurm_launcher(self.config, self.folder)


@contextmanager
def open_launcher(config: LauncherConfig, workers: int, folder: Path) -> Iterator[Launcher]:
    """The launcher that the type of `config` stands for; its processes end with the context.

    `workers` is the number of local processes, `folder` the place for a cluster's logs.
    """
    match config:
        case LocalConfig():
            with LocalLauncher(workers) as local:
                yield local
        case SlurmConfig():
            yield _WhenNeeded(config, folder)
        case _:
            raise InputError(f"launcher={config.name}: unknown; choose local or slurm")
