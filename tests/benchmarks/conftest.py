"""A small finished table that tests read, or damage a copy of."""

import shutil
from multiprocessing.context import ForkServerContext
from pathlib import Path

import pytest

from tests.benchmarks.tables import run_greys, write_own


@pytest.fixture(scope="session")
def own(fork_server: ForkServerContext, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A third party's folder of methods and tables."""
    return write_own(tmp_path_factory.mktemp("own"))


@pytest.fixture(scope="session")
def finished(own: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its table's output folder; it is only read."""
    output = tmp_path_factory.mktemp("results")
    assert run_greys(own, output) == 0
    return output


@pytest.fixture
def copy(finished: Path, tmp_path: Path) -> Path:
    """The same to change."""
    shutil.copytree(finished, tmp_path / "results")
    return tmp_path / "results"
