"""Timing two implementations against each other, and the rows that come of it."""

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.store.atomic import write_atomic


@dataclass(frozen=True)
class Timing:
    """One line of `perf/<name>.csv`."""

    case: str
    device: str
    ours_ms: float
    reference_ms: float
    ratio: float
    """reference / ours, of the medians."""
    max_abs_diff: float


def devices() -> list[torch.device]:
    """The CPU and, where there is one, the GPU."""
    names = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    return [torch.device(name) for name in names]


def compare(
    case: str,
    device: torch.device,
    ours: Callable[[], Float[Tensor, "..."]],
    reference: Callable[[], Float[Tensor, "..."]],
    repeats: int = 15,
    clock: Callable[[], float] = time.perf_counter,
) -> Timing:
    """Run both in turn, so that whatever else the machine does hits both; one round to warm up.

    `time.process_time` as the clock counts the cores' time instead, on a CPU.

    Prints the outcome on standard error: the next row may take minutes.
    """
    difference = float((ours() - reference()).abs().max())
    pairs = [
        (_milliseconds(ours, device, clock), _milliseconds(reference, device, clock))
        for _ in range(repeats)
    ]
    ours_ms, reference_ms = (statistics.median(side) for side in zip(*pairs, strict=True))
    row = Timing(case, device.type, ours_ms, reference_ms, reference_ms / ours_ms, difference)
    print(
        f"{case}, {row.device}: {ours_ms:.4g} ms, reference {reference_ms:.4g} ms, "
        f"{row.ratio:.3g} times",
        file=sys.stderr,
        flush=True,
    )
    return row


def write_rows(rows: Sequence[Timing], path: Path) -> None:
    """Write the rows as CSV."""
    write_atomic(path, pd.DataFrame(rows).to_csv(index=False, float_format="%.4g").encode())


def print_rows(rows: Sequence[Timing]) -> None:
    """Print the same columns, aligned."""
    print(pd.DataFrame(rows).to_string(index=False, float_format=lambda value: f"{value:.4g}"))


def _milliseconds(
    function: Callable[[], Float[Tensor, "..."]], device: torch.device, clock: Callable[[], float]
) -> float:
    _synchronize(device)
    start = clock()
    function()
    _synchronize(device)
    return (clock() - start) * 1e3


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
