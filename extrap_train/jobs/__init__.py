"""Independent jobs that leave files behind: here, as a SLURM array, or on Ray.

A job is a function at a module's top level and an item; both are pickled. Its files are its result:
what it returns is a small record, and a job that finds its files finished returns at once. So
nothing is lost when any of this is killed, and the same command goes on where it stopped.
"""

import multiprocessing
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from typing import Protocol, TypeVar, runtime_checkable

ONE_THREAD = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""What tells the libraries of a worker process how many threads they have, before they load."""

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Died:
    """The result of a job whose process died or ran out of memory, also on its own."""

    reason: str


@runtime_checkable
class Launcher(Protocol):
    """Where jobs run."""

    def run(
        self, job: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Died]]:
        """Each item's index with its result, in the order in which they are done.

        An exception of a job is raised here and ends everything, so a job returns what the others
        are to survive. A job that takes its process with it or raises MemoryError is tried once
        more, alone.
        """
        ...


def run_share(
    job: Callable[[Item], Result], items: Sequence[Item]
) -> list[Result | Died] | BaseException:
    """The results, or what one job raised: as an object, which a cluster's library would turn into
    text."""
    results: list[Result | Died] = []
    try:
        for item in items:
            try:
                results.append(job(item))
            except MemoryError as error:
                results.append(Died(f"out of memory ({error})"))
    except Exception as error:
        return error
    return results


def available_cores() -> int:
    """How many cores this process may use; where the system does not say, all of the machine's."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def start_fork_server(preload: Collection[str]) -> ForkServerContext:
    """Start this process's server unless it runs; returns what starts processes from it.

    The server imports the modules `preload`, which must start no thread and open no GPU then. It
    holds none of this process's threads and devices, its libraries have one thread each, and it
    ends with this process. There is one per process: whoever starts it first decides what it
    imports, and its workers import the rest themselves.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*preload])
    before = dict(os.environ)
    os.environ |= dict.fromkeys(ONE_THREAD, "1")  # libraries read them as they load
    try:
        forkserver.ensure_running()
    finally:
        os.environ.clear()
        os.environ.update(before)
    return context
