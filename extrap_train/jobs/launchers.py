"""A launcher from its options."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from extrap_train.config import LauncherConfig, LocalConfig, RayConfig, SlurmConfig
from extrap_train.errors import InputError
from extrap_train.jobs import Launcher
from extrap_train.jobs.local import LocalLauncher
from extrap_train.jobs.ray import RayLauncher
from extrap_train.jobs.slurm import slurm_launcher


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
            yield slurm_launcher(config, folder)
        case RayConfig():
            with RayLauncher(config) as cluster:
                yield cluster
        case _:
            raise InputError(f"launcher={config.name}: unknown; choose local, slurm or ray")
