"""Jobs on a Ray cluster: here on a stand-in for its library, which runs every task when its result
is asked for; `tests/data_prep/test_preparation_on_ray.py` starts a real cluster.
"""

import os
import signal
import socket
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from extrap_train.config import RayConfig
from extrap_train.errors import InputError
from extrap_train.jobs import ONE_THREAD, Died
from extrap_train.jobs.launchers import open_launcher


class RayError(Exception):
    pass


class RayTaskError(RayError):
    pass


class RuntimeEnvSetupError(RayError):
    pass


class Killed(BaseException):
    """What ends a process of the cluster."""


@dataclass(eq=False)
class Cluster:
    """As much of Ray as the launcher uses."""

    init_arguments: dict[str, Any] = field(default_factory=dict)
    options_given: dict[str, Any] = field(default_factory=dict)
    waiting: list[object] = field(default_factory=list)
    handed_out: list[int] = field(default_factory=list)
    cancelled: list[object] = field(default_factory=list)
    is_shut_down: bool = False
    exceptions = SimpleNamespace(
        RayError=RayError, RayTaskError=RayTaskError, RuntimeEnvSetupError=RuntimeEnvSetupError
    )

    def init(self, address: str, **arguments: Any) -> None:
        self.init_arguments = {"address": address, **arguments}
        signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def remote(self, function: Callable[..., object]) -> SimpleNamespace:
        def options(**given: object) -> SimpleNamespace:
            self.options_given = given
            return SimpleNamespace(remote=lambda *arguments: self._submit(function, arguments))

        return SimpleNamespace(options=options)

    def _submit(self, function: Callable[..., object], arguments: tuple[object, ...]) -> object:
        task = _Task(lambda: function(*arguments))
        self.waiting.append(task)
        self.handed_out.append(len(self.waiting))
        return task

    def wait(self, tasks: list[object]) -> tuple[list[object], list[object]]:
        return tasks[-1:], tasks[:-1]

    def get(self, task: "_Task") -> object:
        self.waiting.remove(task)
        try:
            return task.run()
        except Killed:
            raise RayError("the worker\ndied") from None
        except ImportError as error:
            raise RayTaskError(f"a traceback\n{error!r}") from None

    def cancel(self, task: object, force: bool) -> None:
        self.cancelled.append(task)

    def nodes(self) -> list[dict[str, bool]]:
        return [{"Alive": True}, {"Alive": False}]

    def shutdown(self) -> None:
        self.is_shut_down = True


@dataclass(frozen=True, eq=False)
class _Task:
    run: Callable[[], object]


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Cluster:
    made = Cluster()
    monkeypatch.setitem(sys.modules, "ray", made)
    return made


def run(job: Callable[[int], object], count: int, **options: Any) -> dict[int, object]:
    with open_launcher(RayConfig(**options), 1, Path()) as launcher:
        done = [*launcher.run(job, range(count))]
    assert len({index for index, _ in done}) == len(done)
    return dict(done)


def test_every_item_has_its_result_once_and_few_wait_at_a_time(cluster: Cluster) -> None:
    assert run(lambda x: x * x, 20, at_once=3) == {i: i * i for i in range(20)}
    assert max(cluster.handed_out) == 3
    assert cluster.is_shut_down


def test_a_cluster_is_asked_for_with_the_first_jobs_only(cluster: Cluster) -> None:
    assert run(abs, 0) == {}
    with open_launcher(RayConfig(), 1, Path()):
        assert not cluster.init_arguments


def test_jobs_have_what_was_asked_for(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", "/own/modules")
    before = signal.getsignal(signal.SIGTERM)
    run(abs, 1, cpus=2, gpus=0.25, memory_gib=1.5)
    given = cluster.options_given
    assert (given["num_cpus"], given["num_gpus"], given["memory"]) == (2, 0.25, 1.5 * 2**30)
    environment = cluster.init_arguments["runtime_env"]["env_vars"]
    assert environment == {"PYTHONPATH": "/own/modules"} | dict.fromkeys(ONE_THREAD, "2")
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_job_that_takes_its_process_along_harms_no_other(cluster: Cluster) -> None:
    """Item 1 dies once, as if its machine had gone, and item 2 always."""
    tried: list[int] = []

    def job(number: int) -> int:
        tried.append(number)
        if number == 2 or (number == 1 and tried.count(1) == 1):
            raise Killed
        if number == 3:
            raise MemoryError("too large")
        return number

    done = run(job, 5)
    assert [isinstance(done[i], Died) for i in range(5)] == [False, False, True, True, False]
    assert [done[i] for i in (0, 1, 4)] == [0, 1, 4]
    assert sorted(tried) == [0, 1, 1, 2, 2, 3, 3, 4]
    assert cluster.handed_out[-3:] == [1, 1, 1], "tried again one by one: one machine is alive"


def test_an_exception_ends_everything_and_keeps_its_kind(cluster: Cluster) -> None:
    def job(number: int) -> None:
        raise OSError(28, "no space")

    with pytest.raises(OSError, match="no space") as caught:
        run(job, 4)
    assert caught.value.errno == 28
    assert len(cluster.cancelled) == 3
    assert cluster.is_shut_down


def test_a_machine_that_lacks_the_project_or_the_folders_is_one_line(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    def change_folder(folder: str) -> None:
        raise ImportError("no module named extrap_train")

    monkeypatch.setattr(os, "chdir", change_folder)
    with pytest.raises(InputError, match=r"launcher=ray: .*no module named extrap_train") as said:
        run(abs, 1)
    assert "\n" not in str(said.value)


def test_a_missing_extra_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"extrap-train\[ray\]"):
        run(abs, 1)


@pytest.mark.usefixtures("cluster")
def test_an_address_without_a_cluster_is_one_line() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
        for wrong in (address, "nonsense", "host:port"):
            with pytest.raises(InputError, match=f"launcher.address={wrong}: "):
                run(abs, 1, address=wrong)
