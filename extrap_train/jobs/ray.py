"""Jobs as tasks of a Ray cluster."""

import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any

from extrap_train.config import RayConfig
from extrap_train.errors import InputError
from extrap_train.jobs import ONE_THREAD, Died, Item, Result, run_share

_CONNECT_S = 10.0


class RayLauncher:
    """One task per item on a Ray cluster that is already running.

    A context manager: it connects with its first jobs and disconnects at the end, which also ends
    what is still under way, however the command ends. A job that died is tried again beside at
    most one other such job per machine.
    """

    def __init__(self, config: RayConfig) -> None:
        self.config = config

    def __enter__(self) -> "RayLauncher":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if "_ray" in vars(self):
            self._ray.shutdown()

    @cached_property
    def _ray(self) -> Any:
        """The module, connected."""
        return _connect(self.config)

    def run(
        self, job: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Died]]:
        """See `Launcher`."""
        died = []
        for index, result in self._run(job, items, range(len(items)), self.config.at_once):
            if isinstance(result, Died):
                died.append(index)
            else:
                yield index, result
        if died:
            machines = sum(node["Alive"] for node in self._ray.nodes())
            yield from self._run(job, items, died, max(1, machines))

    def _run(
        self,
        job: Callable[[Item], Result],
        items: Sequence[Item],
        indices: Sequence[int],
        at_once: int,
    ) -> Iterator[tuple[int, Result | Died]]:
        waiting = iter(indices)
        running: dict[Any, int] = {}
        try:
            while True:
                for index in islice(waiting, at_once - len(running)):
                    running[self._task.remote(job, items[index], str(Path.cwd()))] = index
                if not running:
                    return
                done, _ = self._ray.wait([*running])
                for task in done:
                    index = running.pop(task)
                    yield index, self._result_of(task)
        finally:
            for task in running:
                self._ray.cancel(task, force=True)

    @cached_property
    def _task(self) -> Any:
        """A job runs once: `run` decides what is tried again, and where."""
        return self._ray.remote(_run_job).options(
            num_cpus=self.config.cpus,
            num_gpus=self.config.gpus,
            memory=round(self.config.memory_gib * 2**30),
            max_retries=0,
            scheduling_strategy="SPREAD",
        )

    def _result_of(self, task: Any) -> Any:
        """A job's result, or why its process has none; raises what the job raised."""
        errors = self._ray.exceptions
        try:
            result = self._ray.get(task)
        except (errors.RayTaskError, errors.RuntimeEnvSetupError) as error:
            said = str(error).strip().splitlines()[-1]
            raise InputError(
                f"launcher=ray: a machine of the cluster cannot run jobs ({said}); every machine "
                "needs this version of the project and must see the same folders"
            ) from None
        except errors.RayError as error:
            return Died(f"its process on the cluster has ended ({_one_line(error)})")
        if isinstance(result, BaseException):
            raise result
        return result


def _run_job(
    job: Callable[[Item], Result], item: Item, folder: str
) -> Result | Died | BaseException:
    """Run a job in a process of the cluster, in the command's own folder: paths may be relative."""
    os.chdir(folder)
    results = run_share(job, [item])
    return results if isinstance(results, BaseException) else results[0]


def _connect(config: RayConfig) -> Any:
    """The module `ray`, connected to the cluster; InputError where one of them is not there."""
    try:
        import ray
    except ImportError:
        raise InputError("launcher=ray needs Ray: pip install 'extrap-train[ray]'") from None
    environment = dict.fromkeys(ONE_THREAD, str(config.cpus))
    if "PYTHONPATH" in os.environ:
        environment["PYTHONPATH"] = os.environ["PYTHONPATH"]
    handler = signal.getsignal(signal.SIGTERM)
    try:
        if config.address != "auto":  # Ray itself would try for minutes, and then end the process
            host, _, port = config.address.rpartition(":")
            socket.create_connection((host, int(port)), _CONNECT_S).close()
        ray.init(config.address, runtime_env={"env_vars": environment}, logging_level="WARNING")
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(
            f"launcher.address={config.address}: no Ray cluster of this version is there "
            f"({_one_line(error)}); start one with `ray start --head`, or leave launcher=local"
        ) from None
    finally:  # Ray replaces it, and would end the command without a word
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)
    return ray


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]
