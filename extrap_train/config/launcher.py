"""Where independent jobs run."""

from dataclasses import dataclass

from extrap_train.config.options import MISSING, option


@dataclass
class LauncherConfig:
    """Where independent jobs run; one subclass per kind of place."""

    name: str = MISSING


@dataclass
class LocalConfig(LauncherConfig):
    """Processes on this machine, as many as `workers` says."""

    name: str = "local"


@dataclass
class SlurmConfig(LauncherConfig):
    """One SLURM job array; the command waits for it and gathers the results."""

    name: str = "slurm"
    partition: str | None = option(None, "partition of the job array")
    account: str | None = option(None, "account that the job array is charged to")
    tasks: int = option(
        200,
        "array tasks that the jobs are divided among; clusters allow 1001 by default",
        low=1,
        high=1_000_000,
    )
    at_once: int = option(50, "most array tasks that run at a time", low=1, high=1_000_000)
    cpus: int = option(1, "cores per task", low=1, high=1024)
    memory_gib: float = option(4.0, "memory per task", unit="GiB", low=0.5, high=4096)
    hours: float = option(
        4.0,
        "time limit of a task; unfinished jobs are submitted again, one per task",
        unit="hours",
        low=0.02,
        high=10_000,
    )
    directives: dict[str, str] = option(
        {}, "further sbatch options by their long names, as {constraint: avx512}"
    )
