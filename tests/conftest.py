"""Fixtures that every test may use, and how the tests share the machine."""

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

# One thread per worker, and per command that a test starts: the workers share the cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from shape_hook import check_shapes

# Heavy imports stand in what needs them: the process that hands the tests out does without.
check_shapes()

_FORKED = (
    "data_prep.category_pairs",
    "extrap_train.tasks.category",
    "benchmarks.run_table",
    "benchmarks.run.run_method",
    "benchmarks.methods.diffusion",
    "benchmarks.methods.incremental",
    "benchmarks.methods.dngaussian",
)
"""What jobs import that run in processes of their own."""
_MAX_WORKERS = 8  # each holds about 2 GiB


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """One worker per core for whole folders of tests.

    Single files, slow tests and `-s` run in this process: starting workers costs more than it
    saves, or takes the cores or the output away.
    """
    option = config.option
    files = all(Path(argument.split("::")[0]).is_file() for argument in config.args)
    if files or option.markexpr in ("slow", "gpu") or option.capture == "no":
        return 0
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return min(cores or 1, _MAX_WORKERS)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests that compare with a GPU are skipped where torch finds none."""
    if not item.get_closest_marker("gpu"):
        return
    import torch

    if not torch.cuda.is_available():
        pytest.skip(f"needs a CUDA device; torch {torch.__version__} finds none")


@pytest.fixture(scope="session")
def shared() -> Path:
    """Third-party photographs and weights that lie beside the checkout on some machines."""
    folder = Path(__file__).parents[1].parent / "shared"
    if not folder.is_dir():
        pytest.skip("needs the folder of real photographs and weights beside the checkout")
    return folder


@pytest.fixture(scope="session")
def fork_server() -> ForkServerContext:
    """Starts processes that need import nothing, methods under test among them."""
    from extrap_train.jobs import start_fork_server

    return start_fork_server(_FORKED)


@pytest.fixture(scope="session", autouse=True)
def _fork_server_of_a_worker(request: pytest.FixtureRequest) -> None:
    """A test that starts a server for itself would decide what that of the others imports."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        request.getfixturevalue("fork_server")


@pytest.fixture(scope="session", autouse=True)
def _compose_once() -> Iterator[None]:
    """Hydra composes a command's options a first time to look for a sweep in them, and those of
    its jobs to look for mistakes: here only a word or a flag asks for a sweep.
    """
    from hydra._internal.hydra import Hydra
    from hydra.plugins.sweeper import Sweeper

    get_mode = Hydra.get_mode

    def mode(self: Hydra, config_name: str | None, overrides: list[str]) -> Any:
        asked = any(word.startswith("hydra.mode=") for word in overrides)
        return get_mode(self, config_name, overrides) if asked else None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Hydra, "get_mode", mode)
        patch.setattr(Sweeper, "validate_batch_is_legal", lambda *_: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _disk_need_not_keep_up() -> Iterator[None]:
    """Files of tests need not survive a power cut: bringing each to the disk takes milliseconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


def _use_one_thread() -> None:
    import numba
    import torch

    torch.set_num_threads(1)
    numba.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def _one_thread_for_shared_fixtures() -> None:
    _use_one_thread()


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    """Small scenes gain nothing from a second thread, and threads that wait for work cost time."""
    _use_one_thread()


@pytest.fixture(autouse=True)
def _shapes_are_checked_in_every_test() -> None:
    from shape_checks import forget_checks

    forget_checks()


@pytest.fixture(scope="module")
def rendered_once() -> Iterator[None]:
    """Scenes named `synthetic:` and a table's synthetic captures are rendered once per session."""
    from rendered_once import rendered_once

    with rendered_once():
        yield


@pytest.fixture(scope="module")
def coarse_results() -> Iterator[None]:
    """Of a completed scene few frames of its film, few cells of its mesh, and few points of the
    truth that it is scored against.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("extrap_train.reconstruction.cloud_pictures.TURN_FRAMES", 4)
        patch.setattr("extrap_train.reconstruction.map_scores.DENSE_POINTS", 30_000)
        patch.setattr("extrap_train.reconstruction.mesh._CELL", 0.02)
        yield


@pytest.fixture
def measured_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """An adaptation's held-out pairs at one level, with one noise: what follows from their error is
    the same for any number of them.
    """
    monkeypatch.setattr("extrap_train.diffusion.adaptation._LEVELS", 1)
    monkeypatch.setattr("extrap_train.diffusion.adaptation._DRAWS", 1)


@pytest.fixture
def umask() -> Iterator[Callable[[int], int]]:
    """Sets this process's umask until the test ends."""
    before = os.umask(0o022)
    yield os.umask
    os.umask(before)


@contextmanager
def _closed(path: Path) -> Iterator[None]:
    """A file or folder that this process may not read, whoever runs it."""
    mode, user = path.stat().st_mode, os.geteuid()
    path.chmod(0)
    if user == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(user)
        path.chmod(mode)


@pytest.fixture
def closed(tmp_path: Path) -> Callable[[Path], AbstractContextManager[None]]:
    """Closes a path to this process for as long as a block lasts."""
    for folder in (tmp_path, *tmp_path.parents):
        if os.geteuid() == 0 and folder.stat().st_mode & 0o777 == 0o700:
            folder.chmod(0o711)  # pytest's own, through which the test must pass as another user
    return _closed
