"""Jobs that run code that is not ours: each in a process of its own, which leaves nothing behind.

A server that has imported `preload` and done nothing else forks a supervisor for every job, and the
supervisor forks the process that runs the job. So every job finds the same state, nothing that it
changes outlives it, and what it starts or signals is its supervisor's and no other job's.
"""

import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from itertools import islice
from multiprocessing import reduction
from multiprocessing.connection import wait as wait_for_any
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import IO, Any

from extrap_train.jobs import ONE_THREAD, Died, Item, start_fork_server

MAX_RESULT_BYTES = 2**30
_TIMED_OUT = 124
"""A supervisor's exit status once the time of its job was up, as that of `timeout`."""
_IGNORED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_LOOK_EVERY_S = 0.01
_GRACE_S = 10.0
"""Until a supervisor that its job has stopped is killed, too."""


@dataclass(frozen=True)
class IsolatedLauncher:
    """Runs jobs that return bytes, `workers` at a time, each for at most `timeout_s` seconds.

    A job that ends without a result, in whatever way, is a `Died` with the reason. One whose
    process was killed is tried once more, alone: another may have filled the memory.
    """

    workers: int
    timeout_s: float
    preload: tuple[str, ...] = ()
    """Modules that jobs need; they must start no thread and open no GPU when imported."""

    def run(
        self, job: Callable[[Item], bytes], items: Sequence[Item]
    ) -> Iterator[tuple[int, bytes | Died]]:
        """Each item's index with what its job returned, in the order in which they are done."""
        killed = []
        for index, result in self._run(job, dict(enumerate(items)), self.workers):
            if isinstance(result, _Killed):
                killed.append(index)
            else:
                yield index, result
        for index in killed:
            yield from self._run(job, {index: items[index]}, 1)

    def _run(
        self, job: Callable[[Item], bytes], items: Mapping[int, Item], workers: int
    ) -> Iterator[tuple[int, bytes | Died]]:
        waiting = iter(items.items())
        running: dict[int, tuple[int, _JobProcess]] = {}
        with ExitStack() as ends_all:
            while True:
                for index, item in islice(waiting, workers - len(running)):
                    started = _JobProcess(self._start, job, item, self.timeout_s)
                    ends_all.callback(started.end)
                    running[started.process.sentinel] = (index, started)
                if not running:
                    return
                wait_for_any([*running], timeout=1.0)
                for sentinel, (index, started) in [*running.items()]:
                    if started.is_over:
                        del running[sentinel]
                        yield index, started.result()

    def _start(self, arguments: tuple[Any, ...]) -> BaseProcess:
        process = start_fork_server(self.preload).Process(target=_supervise, args=arguments)
        process.start()
        return process


@dataclass(frozen=True)
class IsolatedJob:
    """A job for another launcher, whose processes each run it in a process of its own."""

    job: Callable[[Any], bytes]
    timeout_s: float
    preload: tuple[str, ...]

    def __call__(self, item: Any) -> bytes | Died:
        """The job's result."""
        ((_, result),) = IsolatedLauncher(1, self.timeout_s, self.preload).run(self.job, [item])
        return result


class _Killed(Died):
    """Its process was killed, by itself or for want of memory."""


class _JobProcess:
    """A job under way, seen from the process that waits for it."""

    def __init__(
        self,
        start: Callable[[tuple[Any, ...]], BaseProcess],
        job: Callable[[Item], bytes],
        item: Item,
        timeout_s: float,
    ) -> None:
        self._timeout_s = timeout_s
        self._file: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - `end` closes it
        environment = dict(os.environ) | dict.fromkeys(ONE_THREAD, "1")
        self.process = start((job, item, _Sink(self._file.fileno()), environment, timeout_s))
        self._given_up = time.monotonic() + timeout_s + _GRACE_S

    @property
    def is_over(self) -> bool:
        """Whether its process has ended, or will not end by itself."""
        return self.process.exitcode is not None or time.monotonic() > self._given_up

    def result(self) -> bytes | Died:
        """What the job returned, or why there is nothing."""
        code = self.process.exitcode
        try:
            if code is None or code == _TIMED_OUT:
                return Died(f"took longer than {self._timeout_s:g} s")
            if code == -signal.SIGKILL or code == 255:  # 255: nobody knows, the server was killed
                return _Killed("its process was killed, by itself or for want of memory")
            if code < 0:
                return Died(f"its process was ended by {signal.Signals(-code).name}")
            size = os.fstat(self._file.fileno()).st_size
            if code or not size:
                return Died(f"its process ended without a result, with exit status {code}")
            if size > MAX_RESULT_BYTES:
                return Died(f"its result is larger than {MAX_RESULT_BYTES >> 20} MiB")
            return os.pread(self._file.fileno(), size, 0)
        finally:
            self.end()

    def end(self) -> None:
        """End whatever is left of it."""
        if self._file.closed:
            return
        self._file.close()
        # The supervisor leads a group that holds the job's process and what that has started.
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid or 0, signal.SIGKILL)
        self.process.kill()
        self.process.join(_GRACE_S)


class _Sink:
    """An open file on its way to another process, where it arrives as a descriptor."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def __reduce__(self) -> tuple[Any, ...]:
        return _receive, (reduction.DupFd(self._descriptor),)


def _receive(duplicate: Any) -> int:
    descriptor: int = duplicate.detach()
    return descriptor


def _supervise(
    job: Callable[[Item], bytes],
    item: Item,
    sink: int,
    environment: Mapping[str, str],
    timeout_s: float,
) -> None:
    """Run the job in a child process, wait for it, and end as it ended."""
    deadline = time.monotonic() + timeout_s
    multiprocessing.set_start_method(None, force=True)  # what the job starts, as anywhere else
    os.setsid()  # no Ctrl-C of the terminal reaches it
    for one in _IGNORED:
        signal.signal(one, signal.SIG_IGN)  # a job may send them to its parent
    _adopt_orphans()
    child = os.fork()
    if child == 0:
        _run_job(job, item, sink, environment)
    parent = multiprocessing.parent_process()
    assert parent is not None
    status, code = 0, _TIMED_OUT
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            code = os.waitstatus_to_exitcode(status)
            break
        if wait_for_any([parent.sentinel], _LOOK_EVERY_S) or time.monotonic() > deadline:
            break
    _end_descendants()
    if code < 0:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.signal(-code, signal.SIG_DFL) if -code != signal.SIGKILL else None
        os.kill(os.getpid(), -code)
    os._exit(code)


def _run_job(
    job: Callable[[Item], bytes], item: Item, sink: int, environment: Mapping[str, str]
) -> None:
    """Run the job and leave by the shortest way: threads and exit handlers are not waited for."""
    own, code = os.getpid(), 1
    try:
        for one in _IGNORED:
            signal.signal(one, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.environ.clear()
        os.environ.update(environment)
        content = memoryview(job(item))
        while os.getpid() == own and content:  # a job that forks comes here twice
            content = content[os.write(sink, content) :]
        code = 0
        with suppress(ValueError, OSError, AttributeError):  # closed or replaced by the job
            sys.stdout.flush()
    finally:
        os._exit(code)


def _adopt_orphans() -> None:
    """Become the parent of what descendants leave behind, where the system has that."""
    if sys.platform == "linux":
        import ctypes

        pr_set_child_subreaper = 36
        ctypes.CDLL(None).prctl(pr_set_child_subreaper, 1)


def _end_descendants() -> None:
    """Kill all children, and theirs as they come."""
    children = Path(f"/proc/self/task/{os.getpid()}/children")
    while children.is_file() and (pids := children.read_text().split()):
        for pid in map(int, pids):
            with suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        with suppress(ChildProcessError):
            os.waitpid(-1, 0)
