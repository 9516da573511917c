"""Jobs as one SLURM job array, through submitit."""

import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from extrap_train.config import SlurmConfig
from extrap_train.errors import InputError
from extrap_train.jobs import Died, Item, Result, run_share


class SubmittedLauncher:
    """Array tasks of a submitit executor; each runs its share of the items one after another.

    It waits for all of them, because whoever submits puts the results together. Interrupted, it
    cancels the tasks; killed, they go on, and the same command later finds what they made.
    """

    def __init__(
        self, open_executor: Callable[[], Any], tasks: int, poll_seconds: float = 5.0
    ) -> None:
        self.open_executor, self.tasks, self.poll_seconds = open_executor, tasks, poll_seconds

    @cached_property
    def _executor(self) -> Any:
        """Opened for the first jobs: often there are none."""
        return self.open_executor()

    def run(
        self, job: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Died]]:
        """See `Launcher`."""
        dealt = [list(range(first, len(items), self.tasks)) for first in range(self.tasks)]
        alone = []
        for index, result in self._run_shares(job, items, dealt):
            if isinstance(result, Died):
                alone.append([index])
            else:
                yield index, result
        for start in range(0, len(alone), self.tasks):
            yield from self._run_shares(job, items, alone[start : start + self.tasks])

    def _run_shares(
        self, job: Callable[[Item], Result], items: Sequence[Item], shares: Sequence[list[int]]
    ) -> Iterator[tuple[int, Result | Died]]:
        """One array task a share; all of it has died where the task ends without a result."""
        from submitit.core.utils import (
            FailedJobError,
            FailedSubmissionError,
            UncompletedJobError,
        )
        from submitit.helpers import as_completed

        shares = [share for share in shares if share]
        if not shares:
            return
        parts = [[items[index] for index in share] for share in shares]
        try:
            submitted = self._executor.map_array(run_share, [job] * len(parts), parts)
        except (FailedJobError, FailedSubmissionError) as error:
            said = " ".join(str(error).split()) or "it said nothing"
            raise InputError(
                f"launcher=slurm: the cluster takes no jobs ({said}); check launcher.partition and "
                "launcher.account, or leave launcher=local"
            ) from None
        share_of = {task.job_id: share for task, share in zip(submitted, shares, strict=True)}
        try:
            for task in as_completed(submitted, poll_frequency=self.poll_seconds):
                share = share_of[task.job_id]
                try:
                    results = task.result()
                except UncompletedJobError:
                    reason = f"its SLURM task ended early; see {task.paths.stderr}"
                    results = [Died(reason)] * len(share)
                if isinstance(results, BaseException):
                    raise results
                yield from zip(share, results, strict=True)
        finally:
            for task in submitted:
                if not task.done():
                    task.cancel()


def slurm_launcher(config: SlurmConfig, folder: Path) -> SubmittedLauncher:
    """A launcher for the cluster that this machine submits to; logs and results go to `folder`.

    With its first jobs it raises InputError where submitit or SLURM is not there.
    """
    return SubmittedLauncher(lambda: _open_slurm(config, folder), config.tasks)


def _open_slurm(config: SlurmConfig, folder: Path) -> Any:
    try:
        import submitit
    except ImportError:
        raise InputError(
            "launcher=slurm needs submitit: pip install 'extrap-train[slurm]'"
        ) from None
    if shutil.which("sbatch") is None:
        raise InputError(
            "launcher=slurm: there is no sbatch on this machine; submit from a login node of the "
            "cluster, or leave launcher=local"
        )
    folder.mkdir(parents=True, exist_ok=True)
    # A folder of its own: a cluster that was set up anew gives old numbers to new jobs, whose
    # results would be found there already.
    executor = submitit.SlurmExecutor(tempfile.mkdtemp(dir=folder))
    optional = {"partition": config.partition, "account": config.account}
    executor.update_parameters(
        job_name="extrap-train",
        time=max(1, round(config.hours * 60)),
        cpus_per_task=config.cpus,
        mem=f"{round(config.memory_gib * 1024)}M",
        array_parallelism=config.at_once,
        additional_parameters=dict(config.directives),
        **{name: value for name, value in optional.items() if value is not None},
    )
    return executor
