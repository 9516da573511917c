"""Verification: every file is hashed and every cell scored again, and every row must be of the
method, options and frames that it is filed under.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from benchmarks.protocol.draws import Draw, Protocol, is_sealed
from benchmarks.protocol.prepared_scene import Scene
from benchmarks.report.aggregate import UNIT, Results, read_results
from benchmarks.report.formats import tables
from benchmarks.run.cells import OK, Cell, read_files
from benchmarks.run.identity import cell_key, image_options, scores_manifest
from benchmarks.run.plan import TableFolder, selected_draws
from benchmarks.score import Score
from benchmarks.score.scoring import score_files
from extrap_train.config import ScoringConfig
from extrap_train.errors import InputError

RELATIVE_TOLERANCE = 1e-4
"""Other processors and library builds round differently."""


@dataclass
class Verification:
    """What came of it."""

    cells: int = 0
    """How many were scored again."""
    problems: list[str] = field(default_factory=list)
    """What does not agree, one line each."""
    unchecked: dict[str, str] = field(default_factory=dict)
    """Columns that this machine cannot judge as the run did, and why."""


def verify(folder: TableFolder, lpips_weights: Mapping[str, str] | None = None) -> Verification:
    """Check a table's results; `lpips_weights` says where weights lie on this machine, by net.

    Raises InputError where there is nothing that could be checked, or a file is damaged.
    """
    results = read_results(folder)
    scoring, unchecked = _scoring_here(results, lpips_weights or {})
    found = Verification(unchecked=unchecked, problems=[*_report_problems(results)])
    made: list[tuple[str, Draw]] = []
    for cell in results.cells:
        scene = Scene.open(folder.scenes / cell.scene)
        made.append((cell.method, scene.draw))
        problems = [*_identity_problems(results, cell, scene)]
        if cell.status == OK:
            found.cells += 1
            problems += _score_problems(results, cell, scene, scoring, unchecked)
        found.problems += [f"{cell.key} ({cell.method}): {p}" for p in problems]
    missing = set(results.plan.cells) - {cell.key for cell in results.cells}
    found.problems += [f"{key}: the cell is missing" for key in sorted(missing)]
    found.problems += _protocol_problems(results, made)
    return found


def _scoring_here(
    results: Results, lpips_weights: Mapping[str, str]
) -> tuple[ScoringConfig, dict[str, str]]:
    """What this machine can judge as the run did, by the weights' content, and the rest with why.

    A column that had no weights in the run is not judged now, and must be empty.
    """
    scoring = results.plan.table.scoring
    there = {net: file for net, file in scoring.lpips_weights.items() if Path(file).is_file()}
    here = replace(scoring, lpips_weights={**there, **lpips_weights})
    hashes, stated = scores_manifest(here).inputs, results.plan.scored_from.inputs
    columns, unchecked = here.judged, {}
    for column in filter(stated.__contains__, columns):
        if column not in hashes:
            option = f"give scoring.{column.replace('lpips_', 'lpips_weights.')}=FILE"
            cache = "put VGG-16 into torch's hub cache"
            how = cache if column == "dists" else option
            unchecked[column] = f"its weights are not here; {how}"
        elif hashes[column] != stated[column]:
            unchecked[column] = "the weights here are not those that it was judged with"
    judged = {c for c in columns if c in stated and c not in unchecked}
    nets = [net for net in here.lpips if f"lpips_{net}" in judged]
    return replace(here, lpips=nets, dists="dists" in judged), unchecked


def _protocol_problems(results: Results, made: Sequence[tuple[str, Draw]]) -> Iterator[str]:
    """Rows or draws that the table has and its cells have not, or the other way round; `made` is
    each cell's method and draw.
    """
    try:
        protocol = Protocol.read(results.folder.protocol)
    except InputError as error:
        yield str(error)
        return
    file, table = results.folder.plan, results.plan.table
    if not is_sealed(file):
        yield f"{file}: was changed after the run, as in its titles; run the table again"
    if protocol.sha256 != results.plan.protocol:
        yield f"{results.folder.protocol}: is not the protocol that the results carry"
    if asdict(protocol.rules) != asdict(table.rules):
        yield f"{file}: its rules are not the protocol's"
    if list(results.methods) != table.methods:
        yield f"{file}: its rows are not the methods of its table"
    for name, given in table.options.items():
        method = results.methods.get(name)
        if method is not None and method.options != {**method.options, **given}:
            yield f"{file}: {name} was not made with the options that its table gives"
    draws = selected_draws(table, protocol, results.plan.quick)
    expected = {f"{name} on {draw.label}": draw for name in table.methods for draw in draws}
    counts = Counter(f"{name} on {draw.label}" for name, draw in made)
    yield from (f"{row}: there is no cell of it" for row in sorted(expected.keys() - counts.keys()))
    yield from (f"{row}: has {count} cells" for row, count in counts.items() if count > 1)
    for name, draw in made:
        if expected.get(row := f"{name} on {draw.label}") != draw:
            yield f"{row}: is not a row and draw of the table"


def _report_problems(results: Results) -> Iterator[str]:
    """CSV files that are not what the cells say."""
    name = results.plan.table.name
    for file, content in tables(results, name).items():
        path = results.folder.path / file
        if not path.is_file():
            yield f"{path}: is missing; `benchmark report {name}` writes it again"
        elif path.read_bytes() != content:
            yield f"{path}: is not what the cells say; `benchmark report {name}` writes it again"


def _identity_problems(results: Results, cell: Cell, scene: Scene) -> Iterator[str]:
    """Differences between a cell's record and its name, its row, its draw or its photographs."""
    if cell_key(cell.made_from, cell.scored_from) != cell.key:
        yield "its name does not follow from what it states that it was made from"
    options = image_options(results.methods[cell.method], results.plan.table.rules, cell.device)
    inputs = {**cell.made_from.inputs, "photographs": scene.data_hash}
    expected = replace(cell.made_from, options=options, inputs=inputs)
    found = expected.differences(cell.made_from)
    found += results.plan.scored_from.differences(cell.scored_from)
    for difference in found:
        yield f"was made with different {difference}"
    for name in (*UNIT, "n_views"):
        stated, drawn = getattr(cell, name), getattr(scene.draw, name)
        if stated != drawn:
            yield f"states {name} {stated}, its photographs are of {drawn}"


def _score_problems(
    results: Results,
    cell: Cell,
    scene: Scene,
    scoring: ScoringConfig,
    unchecked: Mapping[str, str],
) -> Iterator[str]:
    """Photographs that have changed, and numbers that do not follow from the images."""
    changed = scene.changed_files()
    if changed:
        yield f"{scene.file(changed[0])} is missing, or not what its hash says"
        return
    folder = results.folder.cells / cell.key
    again = score_files(folder, *read_files(folder, cell), scene, scoring)
    stated = cell.metrics
    for name in dict.fromkeys([*stated, *again]):
        if name in unchecked:
            continue
        if name not in stated:
            yield f"{name} is not stated, computed as {again[name].value}"
            continue
        before, found = stated[name], again.get(name, Score(None, "nothing judged it"))
        if not _same(before.value, found.value):
            yield f"{name} is stated as {before.value}, computed as {found.value} {found.reason}"
        elif len(before.per_image) != len(found.per_image) or not all(
            map(_same, before.per_image, found.per_image)
        ):
            yield f"{name} by image is stated as {before.per_image}, computed as {found.per_image}"


def _same(stated: float | None, found: float | None) -> bool:
    if stated is None or found is None:
        return stated is found
    return math.isclose(stated, found, rel_tol=RELATIVE_TOLERANCE, abs_tol=1e-6)
