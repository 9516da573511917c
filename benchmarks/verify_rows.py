"""Whether a table's rows are what they are called: a cell a method and draw, each of the method,
options and frames that it is filed under.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict

from benchmarks.method_checks import method_hash
from benchmarks.plan import cell_key, images_hash, selected_draws
from benchmarks.protocol import Draw, Protocol, digest
from benchmarks.records import Cell
from benchmarks.results import UNIT, Results
from benchmarks.scenes import Scene


def plan_problems(
    results: Results, protocol: Protocol, made: Sequence[tuple[str, Draw]]
) -> Iterator[str]:
    """Rows or draws that the table has and its cells have not, or the other way round; `made` is
    each cell's method and draw.
    """
    file = results.folder.plan
    table = results.plan.table
    if protocol.sha256 != results.plan.protocol:
        yield f"{results.folder.protocol}: is not the protocol that the results carry"
    if asdict(protocol.rules) != asdict(table.rules):
        yield f"{file}: its rules are not the protocol's"
    if list(results.methods) != table.methods:
        yield f"{file}: its rows are not the methods of its table"
    for name, given in table.options.items():
        made_by = results.methods.get(name)
        if made_by is not None and made_by.options != {**made_by.options, **given}:
            yield f"{file}: {name} was not made with the options that its table gives"
    draws = selected_draws(table, protocol, results.plan.quick)
    expected = {(name, draw) for name in table.methods for draw in draws}
    counts = Counter(made)
    for name, draw in sorted(expected - counts.keys(), key=_label):
        yield f"{_label((name, draw))}: there is no cell of it"
    for row, count in counts.items():
        if row not in expected:
            yield f"{_label(row)}: is no row and draw of the table"
        elif count > 1:
            yield f"{_label(row)}: has {count} cells"


def _label(row: tuple[str, Draw]) -> str:
    return f"{row[0]} on {row[1].label}"


def cell_problems(results: Results, cell: Cell, scene: Scene) -> Iterator[str]:
    """What a cell says of itself and its hashes, its draw or its row do not."""
    hashes, row = cell.hashes, results.methods[cell.method]
    if images_hash(hashes) != hashes.images or cell_key(hashes) != cell.key:
        yield "its name does not follow from the hashes that it states"
    if hashes.method != method_hash(row):
        yield f"was not made by {row.factory} with the options of its row"
    if cell.options != row.options:
        yield f"states the options {cell.options}, its row has {row.options}"
    if hashes.device != cell.device:
        yield f"states the device {cell.device}, made on {hashes.device}"
    if hashes.rules != digest(asdict(results.plan.table.rules)):
        yield "was made by other rules"
    for name in (*UNIT, "n_views"):
        stated, drawn = getattr(cell, name), getattr(scene.draw, name)
        if stated != drawn:
            yield f"states {name} {stated}, its photographs are of {drawn}"
