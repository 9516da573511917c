"""How the kernels are compiled."""

import inspect
from collections.abc import Callable
from typing import Any

import numba


def compiled(parallel: bool = False, contract: bool = False) -> Callable[[Callable], Any]:
    """Compile a kernel and keep the machine code on disk.

    `contract` fuses multiplications with additions, for sums that no decision hangs on: elsewhere
    the same rounding as in torch is wanted. Shape checkers that wrap every function are looked
    through.
    """

    def compile_kernel(kernel: Callable) -> Any:
        return numba.njit(
            cache=True,
            error_model="numpy",
            parallel=parallel,
            fastmath={"contract"} if contract else False,
        )(inspect.unwrap(kernel))

    return compile_kernel
