"""Results of a table as they would be read, made from given numbers."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from benchmarks.plan import TableFolder
from benchmarks.results import Results


def cell(
    method: str,
    sequence: str,
    seed: int,
    psnr: float | None,
    others: Mapping[str, float | None] = MappingProxyType({}),
    scoring: str = "judges",
    **given: str,
) -> dict[str, Any]:
    """One with three views of a cup; it has failed where `psnr` is None."""
    head = {"method": method, "category": "cup", "sequence": sequence, "draw": "random"}
    head |= {"seed": seed, "n_views": 3, "device": "cpu", "scene": f"cup-{sequence}-3-random-0"}
    head |= {"hashes": {"data": f"photographs of {sequence}", "scoring": scoring}}
    if psnr is None:
        return head | {"status": "failed", "reason": "no luck"}
    scores = {
        name: {"value": value, "reason": "", "per_image": [value]}
        for name, value in {"psnr": psnr, **others}.items()
    }
    measured = {"seconds": 1.0, "peak_memory_mib": 9.0, "given": given}
    return head | {"status": "ok", "reason": "", "metrics": scores} | measured


def results(*cells: dict[str, Any]) -> Results:
    """A table of these cells, with their methods in the order of their first ones."""
    names = dict.fromkeys(cell["method"] for cell in cells)
    table = {"name": "t", "title": "", "columns": ["psnr"]}
    plan = {
        "table": {**table, "rules": {"pool": 9, "image_size": 64, "depth": "dataset"}},
        "protocol": "0" * 64,
        "quick": False,
        "cells": ["key"] * len(cells),
        "methods": {name: {"title": name, "group": "", "time": "in all"} for name in names},
    }
    return Results(TableFolder(Path("nowhere")), plan, list(cells))
