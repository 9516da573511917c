"""Timing two implementations against each other, and the rows that come of it."""

import csv
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Row:
    """One line of `perf/<name>.csv`."""

    case: str
    device: str
    ours_ms: float
    reference_ms: float
    ratio: float
    """reference / ours, of the medians."""
    max_abs_diff: float


def compare(
    case: str,
    device: torch.device,
    ours: Callable[[], Float[Tensor, "..."]],
    reference: Callable[[], Float[Tensor, "..."]],
    repeats: int = 15,
) -> Row:
    """Run both in turn, so that whatever else the machine does hits both; one round to warm up.

    Says on standard error what came out: the next row may take minutes.
    """
    difference = float((ours() - reference()).abs().max())
    pairs = [
        (_milliseconds(ours, device), _milliseconds(reference, device)) for _ in range(repeats)
    ]
    ours_ms, reference_ms = (statistics.median(side) for side in zip(*pairs, strict=True))
    row = Row(case, device.type, ours_ms, reference_ms, reference_ms / ours_ms, difference)
    print(
        f"{case}, {row.device}: {ours_ms:.4g} ms, reference {reference_ms:.4g} ms, "
        f"{row.ratio:.3g} times",
        file=sys.stderr,
        flush=True,
    )
    return row


def write_rows(rows: Sequence[Row], path: Path) -> None:
    """Write the CSV, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    with partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Row)])
        writer.writeheader()
        writer.writerows(_formatted(row) for row in rows)
    partial.replace(path)


def print_rows(rows: Sequence[Row]) -> None:
    """Print the same columns, aligned."""
    lines = [
        [field.name for field in fields(Row)],
        *(list(_formatted(row).values()) for row in rows),
    ]
    widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]
    for line in lines:
        print("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)))


def _formatted(row: Row) -> dict[str, str]:
    return {name: x if isinstance(x, str) else f"{x:.4g}" for name, x in asdict(row).items()}


def _milliseconds(function: Callable[[], Float[Tensor, "..."]], device: torch.device) -> float:
    _wait(device)
    start = time.perf_counter()
    function()
    _wait(device)
    return (time.perf_counter() - start) * 1e3


def _wait(device: torch.device) -> None:
    """GPUs work on behind the caller's back."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
