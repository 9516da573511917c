"""Kernels are compiled once, by one process at a time, and then read from disk."""

import os
import threading
from pathlib import Path

import numba
import pytest
from filelock import FileLock

from extrap_train.geometry.compiled import compiled


def double(number):
    return 2 * number


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    return tmp_path


def test_a_compiled_kernel_is_read_from_disk(cache: Path) -> None:
    first, second = compiled()(double), compiled()(double)
    assert first(3) == second(3) == 6
    assert sum(first.stats.cache_misses.values()) == 1
    assert sum(second.stats.cache_misses.values()) == 0
    assert sum(second.stats.cache_hits.values()) == 1


def test_kernels_that_call_each_other_are_compiled_together(cache: Path) -> None:
    inner = compiled()(double)
    assert compiled()(lambda number: inner(number) + 1)(3) == 7


def test_a_kernel_waits_for_another_process_that_compiles(cache: Path) -> None:
    kernel = compiled()(double)
    caller = threading.Thread(target=kernel, args=(3,))
    with FileLock(Path(kernel.stats.cache_path) / "numba.lock"):
        caller.start()
        caller.join(0.5)
        assert caller.is_alive()
        assert not kernel.signatures
    caller.join(60)
    assert len(kernel.signatures) == 1


def test_a_forked_process_compiles_what_its_parent_has_not(cache: Path) -> None:
    kernel = compiled()(double)
    assert kernel(3) == 6
    child = os.fork()
    if child == 0:
        os._exit(0 if kernel(1.5) == 3 else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
