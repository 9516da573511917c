"""Jobs on this machine. No torch here: a worker says how many threads it has before that loads."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for_any
from types import TracebackType
from typing import Any

from extrap_train.jobs import ONE_THREAD, Died, Item, Result, start_fork_server

WAITING_PER_WORKER = 2
"""Jobs that are handed out ahead of time: memory must not grow with the number of jobs."""


class LocalLauncher:
    """A pool of processes of one thread each, or just this process where `workers` is 1.

    A context manager: the pool starts with the first jobs, serves any number of runs, and ends
    with the context, at once where it ends with an exception. No worker outlives its parent,
    however that ends.
    """

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self._pool: ProcessPoolExecutor | None = None
        self._stay: Connection | None = None
        """Workers leave at once when it is closed."""

    def __enter__(self) -> "LocalLauncher":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None and self._stay is not None:
            self._stay.close()
        self._close()

    def run(
        self, job: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Died]]:
        """See `Launcher`."""
        run = self._run_here if self.workers == 1 or len(items) <= 1 else self._run_in_pool
        died = []
        for index, result in run(job, items):
            if isinstance(result, Died):
                died.append(index)
            else:
                yield index, result
        if died:
            self._close()  # its idle processes hold memory, too
        for index in died:
            with LocalLauncher(2) as alone:
                ((_, result),) = alone._run_in_pool(job, [items[index]])
            yield index, result

    def _run_here(
        self, job: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Died]]:
        for index, item in enumerate(items):
            try:
                yield index, job(item)
            except MemoryError as error:
                yield index, Died(f"out of memory ({error})")

    def _run_in_pool(
        self, job: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[tuple[int, Result | Died]]:
        """What was under way when a process died has died, too."""
        running: dict[Future[Result], int] = {}
        waiting = iter(range(len(items)))
        try:
            while True:
                for index in waiting:
                    running[self._submit(job, items[index])] = index
                    if len(running) >= self.workers * WAITING_PER_WORKER:
                        break
                if not running:
                    return
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    index = running.pop(future)
                    yield index, _result_of(future)
        finally:
            for future in running:
                future.cancel()

    def _submit(self, job: Callable[[Item], Result], item: Item) -> "Future[Result]":
        if self._pool is not None:
            try:
                return self._pool.submit(job, item)
            except BrokenProcessPool:
                self._close()
        # Forked by a server, not by this process, which may hold threads and a GPU.
        context = start_fork_server({job.__module__} - {"__main__"})
        leave, self._stay = context.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(
            self.workers,
            mp_context=context,
            initializer=_prepare_worker,
            initargs=(leave, os.environ | dict.fromkeys(ONE_THREAD, "1")),
        )
        return self._pool.submit(job, item)

    def _close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


def _result_of(future: "Future[Any]") -> Any:
    """A job's result, or why its process has none."""
    try:
        return future.result()
    except BrokenProcessPool:
        return Died("its process was killed, probably for want of memory")
    except MemoryError as error:
        return Died(f"out of memory ({error})")


def _prepare_worker(leave: Connection, environment: Mapping[str, str]) -> None:
    """One thread per worker, and no worker without its parent: it leaves when that has died or is
    interrupted, and is deaf to the Ctrl-C that reaches both.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.clear()
    os.environ |= environment
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        wait_for_any([parent.sentinel, leave])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
