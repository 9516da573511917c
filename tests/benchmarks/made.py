"""Results of a table as they would be read, made from given numbers."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from benchmarks.report.aggregate import Results
from benchmarks.run.cells import Cell, Plan
from benchmarks.run.plan import TableFolder
from benchmarks.score import Score
from extrap_train.config import MethodConfig, TableConfig
from extrap_train.store.manifest import Manifest


def cell(
    method: str,
    sequence: str,
    seed: int,
    psnr: float | None,
    others: Mapping[str, float | None] = MappingProxyType({}),
    scoring: str = "judges",
    **given: str,
) -> Cell:
    """One with three views of a cup; it has failed where `psnr` is None."""
    state = {"status": "failed", "reason": "no luck"} if psnr is None else {"status": "ok"}
    scores = {} if psnr is None else {"psnr": psnr, **others}
    return Cell(
        key="key",
        method=method,
        category="cup",
        sequence=sequence,
        n_views=3,
        draw="random",
        seed=seed,
        scene=f"cup-{sequence}-3-random-0",
        protocol="0" * 64,
        made_from=Manifest.of({"device": "cpu"}, {"photographs": f"of {sequence}"}),
        scored_from=Manifest.of({}, {"code": scoring}),
        seconds=1.0,
        peak_memory_mib=9.0,
        given=given,
        metrics={name: Score(value, "", [value]) for name, value in scores.items()},
        **state,  # type: ignore[arg-type]
    )


def results(*cells: Cell) -> Results:
    """A table of these cells, with their methods in the order of their first ones."""
    names = dict.fromkeys(cell.method for cell in cells)
    methods = {name: MethodConfig(name=name, title=name, factory="a.B") for name in names}
    table = TableConfig(name="t", columns=["psnr"])
    plan = Plan(table, False, "0" * 64, Manifest.of({}), methods, ["key"] * len(cells))
    return Results(TableFolder(Path("nowhere")), plan, list(cells))
