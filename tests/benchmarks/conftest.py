"""A small finished table that tests read, or damage a copy of."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.context import ForkServerContext
from pathlib import Path

import pytest

from tests.benchmarks.tables import run_greys, write_own


@contextmanager
def _few_points() -> Iterator[None]:
    """Sample few points of true surfaces, the slowest part of preparing a small capture."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.protocol.captures.DENSE_POINTS", 1000)
        yield


@pytest.fixture(autouse=True, scope="module")
def _rendered_once(rendered_once: None) -> Iterator[None]:
    """See `rendered_once`."""
    with _few_points():
        yield


@pytest.fixture(scope="session")
def own(fork_server: ForkServerContext, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A third party's folder of methods and tables."""
    return write_own(tmp_path_factory.mktemp("own"))


@pytest.fixture(scope="session")
def finished(own: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its table's output folder; it is only read."""
    output = tmp_path_factory.mktemp("results")
    with _few_points():
        assert run_greys(own, output, draws=True) == 0
    return output


@pytest.fixture(scope="session")
def quick(own: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of a quick run of the same table; it is only read."""
    output = tmp_path_factory.mktemp("quick")
    with _few_points():
        assert run_greys(own, output, quick=True) == 0
    return output


@pytest.fixture
def copy(finished: Path, tmp_path: Path) -> Path:
    """The same to change."""
    shutil.copytree(finished, tmp_path / "results")
    return tmp_path / "results"
