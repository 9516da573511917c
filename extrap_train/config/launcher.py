"""Where independent jobs run."""

from dataclasses import dataclass, field

from extrap_train.config.tree import MISSING


@dataclass
class LauncherConfig:
    """Where independent jobs run; one subclass a kind of place."""

    name: str = MISSING


@dataclass
class LocalConfig(LauncherConfig):
    """Processes on this machine, as many as `workers` says."""

    name: str = "local"


@dataclass
class SlurmConfig(LauncherConfig):
    """One SLURM job array; the command waits for it and puts the results together."""

    name: str = "slurm"
    partition: str | None = None
    account: str | None = None
    tasks: int = 200
    """Array tasks that the jobs are dealt to; clusters allow 1001 unless told otherwise."""
    at_once: int = 50
    """Most array tasks that run at a time."""
    cpus: int = 1
    memory_gib: float = 4.0
    hours: float = 4.0
    """Time limit of a task. What it has not finished then is submitted again, an item a task; give
    a share's time (`tasks` shares), or all its unfinished items wait for tasks of their own."""
    directives: dict[str, str] = field(default_factory=dict)
    """Further `sbatch` options by their long names, e.g. {constraint: avx512}."""
