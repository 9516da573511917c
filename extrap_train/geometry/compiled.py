"""How the kernels are compiled."""

import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from filelock import FileLock
from numba.core.compiler_lock import global_compiler_lock


def compiled(parallel: bool = False, contract: bool = False) -> Callable[[Callable], Any]:
    """Compile a kernel and keep the machine code on disk.

    `contract` fuses multiplications with additions, for sums that no decision hangs on: elsewhere
    the same rounding as in torch is wanted.
    """

    def compile_kernel(kernel: Callable) -> Any:
        dispatcher = numba.njit(
            cache=True,
            error_model="numpy",
            parallel=parallel,
            fastmath={"contract"} if contract else False,
        )(kernel)
        _compile_once(dispatcher)
        return dispatcher

    return compile_kernel


def _compile_once(dispatcher: Any) -> None:
    """Let other processes wait for the machine code instead of compiling the same.

    numba's index of the code on disk does not lock: of two processes that compile one kernel for
    two types, one could load the other's code.
    """
    compile_or_load = dispatcher.compile
    folder = dispatcher.stats.cache_path

    def compile_alone(signature: Any) -> Any:
        # numba's own lock between threads first: kernels compile the kernels that they call.
        with global_compiler_lock, _lock(folder, os.getpid()):
            return compile_or_load(signature)

    dispatcher.compile = compile_alone


@cache
def _lock(folder: str, process: int) -> FileLock:
    """A process's one lock of a folder, which whoever holds it may take again for the kernels
    within. A forked process must not use its parent's."""
    return FileLock(Path(folder) / "numba.lock")
