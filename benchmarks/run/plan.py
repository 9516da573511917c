"""From a table to its cells: protocol, prepared draws, and what each cell is named by."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from benchmarks.protocol.captures import Capture, freeze, open_captures, trained_models
from benchmarks.protocol.draws import Draw, Protocol, write_sealed
from benchmarks.protocol.prepared_scene import Scene, truths_of
from benchmarks.protocol.scene_writing import prepare_scene
from benchmarks.run.cells import OK, Cell, CellJob, read_cell
from benchmarks.run.identity import (
    MethodContent,
    cell_key,
    identity_of,
    images_manifest,
    preparing_code,
    scores_manifest,
)
from extrap_train.config import DepthConfig, MethodConfig, TableConfig
from extrap_train.data.frame_files import sequence_folder
from extrap_train.data.square_frames import CaptureKeys
from extrap_train.depth.sources import weight_files
from extrap_train.errors import InputError
from extrap_train.store.digests import file_digest, json_digest


@dataclass(frozen=True)
class TableFolder:
    """Where a table's results lie."""

    path: Path

    @property
    def protocol(self) -> Path:
        """The frozen draws."""
        return self.path / "protocol.json"

    @property
    def cells(self) -> Path:
        """One folder per cell."""
        return self.path / "cells"

    @property
    def scenes(self) -> Path:
        """One folder per prepared draw."""
        return self.path / "scenes"

    @property
    def truths(self) -> Path:
        """What the images of those draws are scored against; not there while methods run."""
        return truths_of(self.scenes)

    def scene(self, draw: Draw) -> Path:
        """Where a draw is prepared; its capture's name is untrusted and leads nowhere else."""
        flat = draw.label.replace("/", "\0")  # in no name, so that two names stay two folders
        return sequence_folder(self.path, self.scenes.name, flat)

    @property
    def plan(self) -> Path:
        """The keys of the table as it was last run: what its reports are made of."""
        return self.path / "plan.json"


def selected_draws(table: TableConfig, protocol: Protocol, quick: bool) -> list[Draw]:
    """The draws that a run of the table takes, in the protocol's order; InputError for none."""
    draws = [draw for draw in protocol.draws if draw.draw in table.draws]
    if not draws:
        raise InputError(f"no draw of {table.draws} in the protocol; see table and rules.draws")
    if not quick:
        return draws
    sequences: dict[str, dict[str, None]] = {}
    for draw in draws:
        sequences.setdefault(draw.category, {})[draw.sequence] = None
    kept = {
        (category, name)
        for category in table.quick.categories or sequences
        for name in [*sequences.get(category, ())][: table.quick.sequences]
    }
    if not kept:
        raise InputError(
            f"quick.categories={table.quick.categories}: the table has no captures of them; give "
            f"quick.categories={sorted(sequences)}"
        )
    return [draw for draw in draws if (draw.category, draw.sequence) in kept]


def open_protocol(
    table: TableConfig, folder: TableFolder, methods: Iterable[MethodConfig] = ()
) -> tuple[Protocol, list[Capture]]:
    """The table's frozen protocol, made now if there is none yet, and its captures.

    One without any result is made anew. Raises InputError where the folder holds results of another
    protocol, for two captures of one name, and for one that a method's model was trained on.
    """
    categories = table.captures.categories
    captures = open_captures(table.captures, categories, trained_models(methods, categories))
    _require_own_names(captures)
    fresh = freeze(table.captures, table.rules, captures)
    if not folder.protocol.is_file() or not any(folder.cells.glob("*/cell.json")):
        write_sealed(folder.protocol, fresh)
        return fresh, captures
    frozen = Protocol.read(folder.protocol)
    if frozen != fresh:
        raise InputError(
            f"{folder.path}: holds results of another protocol ({frozen.sha256[:12]}, this one is "
            f"{fresh.sha256[:12]}: {_difference(frozen, fresh)}); choose another output="
        )
    return frozen, captures


def _require_own_names(captures: Iterable[Capture]) -> None:
    """A draw knows its capture by name."""
    counts = Counter(f"{c.sequence.category}/{c.sequence.name}" for c in captures)
    (name, count), *_ = counts.most_common(1) or [("", 0)]
    if count > 1:
        raise InputError(f"two captures are called {name}; rename one's folder")


def _difference(frozen: Protocol, fresh: Protocol) -> str:
    before, now = asdict(frozen.rules), asdict(fresh.rules)
    changed = [f"rules.{k} was {before[k]}, is {now[k]}" for k in now if before[k] != now[k]]
    return "; ".join(changed) or "other captures or frames"


def prepare_draws(
    table: TableConfig,
    folder: TableFolder,
    draws: list[Draw],
    captures: list[Capture],
    depth: DepthConfig,
) -> Iterable[Scene]:
    """Every draw's folder, one after another, made where it is missing or of another origin."""
    by_name = {(c.sequence.category, c.sequence.name): c for c in captures}
    files = [path for path in weight_files(depth) if path.is_file()]
    made_by = [preparing_code(), asdict(table.captures), asdict(table.rules)]
    made_by += [asdict(depth), {str(file): file_digest(file) for file in files}]
    for draw in draws:
        capture = by_name[draw.category, draw.sequence]
        shown = CaptureKeys.of(capture.sequence)
        origin = json_digest([*made_by, asdict(draw), shown.content, shown.files])
        yield prepare_scene(folder.scene(draw), capture, draw, table.rules, depth, origin)


def cell_jobs(
    table: TableConfig,
    folder: TableFolder,
    protocol: Protocol,
    configs: Sequence[MethodConfig],
    contents: Mapping[str, MethodContent],
    scenes: list[Scene],
) -> list[CellJob]:
    """One job per method and draw, scene by scene, each named by all that decides its result."""
    device = device_of(table)
    scored_from = scores_manifest(table.scoring)
    jobs = []
    for scene in scenes:
        for config in configs:
            content = contents[config.name]
            weights, code = content.weights[scene.draw.category], content.code
            made_from = images_manifest(config, scene, weights, code, protocol.rules, device)
            jobs.append(
                CellJob(
                    folder=folder.cells / cell_key(made_from, scored_from),
                    scene=scene.folder,
                    draw=scene.draw,
                    method=config,
                    scoring=table.scoring,
                    device=device,
                    protocol=protocol.sha256,
                    made_from=made_from,
                    scored_from=scored_from,
                )
            )
    return jobs


def device_of(table: TableConfig) -> str:
    """Where methods run; InputError where that is not here."""
    device = "cuda" if table.device != "cpu" and torch.cuda.is_available() else "cpu"
    if table.device == "cuda" and device == "cpu":
        raise InputError("device=cuda: there is no CUDA device here; give device=cpu")
    return device


def require_different(methods: Iterable[MethodConfig]) -> None:
    """InputError for two methods that are the same: one cell cannot be two rows."""
    known: dict[str, MethodConfig] = {}
    for method in methods:
        other = known.setdefault(json_digest([method.factory, method.options]), method)
        if other is not method:
            raise InputError(
                f"methods {other.name} and {method.name} are the same, with the same options; "
                "leave one out: methods=[...]"
            )


@dataclass(frozen=True)
class OpenJobs:
    """The jobs of a table by what is left to do."""

    done: list[CellJob]
    to_make: list[CellJob]
    to_score: list[CellJob]
    """They know where the images are that their method has made."""


def open_jobs(jobs: list[CellJob], folder: TableFolder, say: Callable[[str], None]) -> OpenJobs:
    """Find what is finished and what only needs scoring; damaged cells are announced."""
    found = OpenJobs([], [], [])
    images: dict[str, Path] | None = None
    for job in jobs:
        cell = _sound_cell(job.folder, say)
        if cell is not None and cell.status == OK:
            found.done.append(job)
            continue
        images = _cells_with_images(folder) if images is None else images
        if there := images.get(identity_of(job.made_from)):
            found.to_score.append(replace(job, unscored_cell=there))
        else:
            found.to_make.append(job)
    return found


def _sound_cell(folder: Path, say: Callable[[str], None]) -> Cell | None:
    try:
        return read_cell(folder)
    except InputError as error:
        say(f"{error}: made again")
        return None


def _cells_with_images(folder: TableFolder) -> dict[str, Path]:
    """By what decides the images."""
    found: dict[str, Path] = {}
    for file in folder.cells.glob("*/cell.json"):
        cell = _sound_cell(file.parent, lambda _: None)
        if cell is not None and cell.images:
            found[identity_of(cell.made_from)] = file.parent
    return found
