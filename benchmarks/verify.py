"""Every number of a table, computed anew from the saved images and hashes."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

from benchmarks.cells import OK, read_cell_files, score_cell, scores_of
from benchmarks.plan import TableFolder, cell_key, images_hash
from benchmarks.protocol import Protocol
from benchmarks.report.text import tables
from benchmarks.results import Results, read_results
from benchmarks.scenes import Scene
from benchmarks.scoring import Score
from extrap_train.config import ScoringConfig
from extrap_train.errors import InputError

RELATIVE_TOLERANCE = 1e-4
"""Other processors and library builds round differently."""


def verify(folder: TableFolder) -> tuple[int, list[str]]:
    """How many cells were checked, and what does not agree, a line each."""
    results = read_results(folder)
    problems = [*_protocol_problems(results), *_report_problems(results)]
    checked = 0
    for cell in results.cells:
        if cell["status"] == OK:
            checked += 1
            problems += [f"{cell['key']} ({cell['method']}): {p}" for p in _problems(results, cell)]
    missing = set(results.plan["cells"]) - {cell["key"] for cell in results.cells}
    return checked, problems + [f"{key}: the cell is missing" for key in sorted(missing)]


def _protocol_problems(results: Results) -> Iterator[str]:
    try:
        protocol = Protocol.read(results.folder.protocol)
    except InputError as error:
        yield str(error)
        return
    if protocol.sha256 != results.plan["protocol"]:
        yield f"{results.folder.protocol}: is not the protocol that the results carry"


def _report_problems(results: Results) -> Iterator[str]:
    """Reports that are not what the cells say, of those that are there."""
    name = results.plan["table"]["name"]
    for file, content in tables(results, name).items():
        path = results.folder.path / file
        if path.is_file() and path.read_bytes() != content:
            yield f"{path}: is not what the cells say; `benchmark report {name}` writes it again"


def _problems(results: Results, cell: dict[str, Any]) -> Iterator[str]:
    hashes = cell["hashes"]
    if images_hash(hashes) != hashes["images"] or cell_key(hashes) != cell["key"]:
        yield "its name does not follow from the hashes that it states"
    scene = Scene.open(results.folder.scenes / cell["scene"])
    changed = scene.changed_files()
    if changed:
        yield f"{scene.folder / changed[0]} is not what its hash says"
        return
    if scene.data_hash != hashes["data"]:
        yield f"{scene.folder} holds other data than the cell was made from"
        return
    folder = results.folder.cells / cell["key"]
    pictures, points = (read_cell_files(folder, cell, kind) for kind in ("images", "points"))
    scoring = ScoringConfig(**results.plan["table"]["scoring"])
    again = score_cell(pictures, points, scene.truth(), scoring)
    stated = scores_of(cell)
    for name in dict.fromkeys([*stated, *again]):
        if name not in stated:
            yield f"{name} is not stated, computed as {again[name].value}"
            continue
        said, found = stated[name], again.get(name, Score(None, "the metric is not known any more"))
        if not _same(said.value, found.value):
            yield f"{name} is stated as {said.value}, computed as {found.value} {found.reason}"
        elif not _all_same(said.per_image, found.per_image):
            yield f"{name} by image is stated as {said.per_image}, computed as {found.per_image}"


def _all_same(stated: Sequence[float | None], found: Sequence[float | None]) -> bool:
    return len(stated) == len(found) and all(map(_same, stated, found))


def _same(stated: float | None, found: float | None) -> bool:
    if stated is None or found is None:
        return stated is found
    return math.isclose(stated, found, rel_tol=RELATIVE_TOLERANCE, abs_tol=1e-6)
