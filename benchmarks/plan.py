"""From a table to its cells: protocol, prepared draws, and what each cell is named by."""

import inspect
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from benchmarks.backbones import judging_files
from benchmarks.captures import Capture, freeze, open_captures
from benchmarks.cell_job import CellJob
from benchmarks.fingerprint import code_hash, weights_hash
from benchmarks.method_checks import method_hash, require_different, require_options_fit
from benchmarks.methods.base import Unavailable
from benchmarks.methods.build import build_method
from benchmarks.protocol import Draw, Protocol, digest
from benchmarks.records import Hashes
from benchmarks.scene_writing import prepare_scene
from benchmarks.scenes import Scene, truths_of
from benchmarks.training import trained_models
from extrap_train.config import MethodConfig, TableConfig
from extrap_train.data.frame_files import sequence_folder
from extrap_train.errors import InputError

KEY_LENGTH = 20
"""Hexadecimal digits of a cell's key."""
_IMAGES = ("method", "code", "weights", "data", "device", "rules")


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
        """A folder a cell."""
        return self.path / "cells"

    @property
    def scenes(self) -> Path:
        """A folder a prepared draw."""
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


@dataclass(frozen=True)
class Selection:
    """Which draws of a protocol are run."""

    categories: tuple[str, ...] = ()
    """Empty: all of the table's."""
    sequences: int | None = None
    """The first so many of every category; None: all."""

    def draws(self, protocol: Protocol, kinds: Iterable[str]) -> list[Draw]:
        """The chosen draws, in the protocol's order."""
        kinds = set(kinds)
        order: dict[str, list[str]] = {}
        for draw in protocol.draws:
            names = order.setdefault(draw.category, [])
            if draw.sequence not in names:
                names.append(draw.sequence)
        return [
            draw
            for draw in protocol.draws
            if draw.draw in kinds
            and (not self.categories or draw.category in self.categories)
            and draw.sequence in order[draw.category][: self.sequences]
        ]


def selected_draws(table: TableConfig, protocol: Protocol, quick: bool) -> list[Draw]:
    """The draws that a run of the table takes; raises InputError where there are none."""
    selection = Selection(tuple(table.quick.categories), table.quick.sequences)
    draws = (selection if quick else Selection()).draws(protocol, table.draws)
    if not draws and quick and Selection().draws(protocol, table.draws):
        raise InputError(
            f"quick.categories={table.quick.categories}: the table has no captures of them; give "
            f"quick.categories={sorted({draw.category for draw in protocol.draws})}"
        )
    if not draws:
        raise InputError(f"no draw of {table.draws} in the protocol; see table and rules.draws")
    return draws


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
        fresh.write(folder.protocol)
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
    known = set()
    for capture in captures:
        name = f"{capture.sequence.category}/{capture.sequence.name}"
        if name in known:
            raise InputError(f"two captures are called {name}; rename one's folder")
        known.add(name)


def _difference(frozen: Protocol, fresh: Protocol) -> str:
    before, now = asdict(frozen.rules), asdict(fresh.rules)
    changed = [f"rules.{k} was {before[k]}, is {now[k]}" for k in now if before[k] != now[k]]
    return "; ".join(changed) or "other captures or frames"


def prepare_draws(
    table: TableConfig, folder: TableFolder, draws: list[Draw], captures: list[Capture]
) -> Iterable[Scene]:
    """Every draw's folder, one after another, made where it is missing or of another origin."""
    by_name = {(c.sequence.category, c.sequence.name): c for c in captures}
    code = code_hash(["benchmarks.scene_writing"])
    for draw in draws:
        origin = digest([code, asdict(table.captures), asdict(table.rules), asdict(draw)])
        capture = by_name[draw.category, draw.sequence]
        yield prepare_scene(folder.scene(draw), capture, draw, table.rules, origin)


def cell_jobs(
    table: TableConfig,
    folder: TableFolder,
    protocol: Protocol,
    methods: list[MethodConfig],
    scenes: list[Scene],
) -> list[CellJob]:
    """A job a method and draw, scene by scene, each named by all that decides its result.

    Raises InputError for two methods that are the same, and for options of a wrong kind.
    """
    require_different(methods)
    for method in methods:
        require_options_fit(method)
    device = _device(table.device)
    scoring = digest(
        [
            asdict(table.scoring) | {"lpips_weights": sorted(table.scoring.lpips_weights)},
            weights_hash([*judging_files(table.scoring).values()]),
            code_hash(["benchmarks.scoring"]),
        ]
    )
    categories = {scene.draw.category for scene in scenes}
    parts = {(m.name, c): _method_hashes(m, c) for m in methods for c in categories}
    jobs = []
    for scene in scenes:
        for method in methods:
            hashes = Hashes(
                protocol=protocol.sha256,
                rules=digest(asdict(protocol.rules)),
                data=scene.data_hash,
                device=device,
                images="",
                scoring=scoring,
                **parts[method.name, scene.draw.category],
            )
            hashes = replace(hashes, images=images_hash(hashes))
            jobs.append(
                CellJob(
                    folder=folder.cells / cell_key(hashes),
                    scene=scene.folder,
                    draw=scene.draw,
                    method=method,
                    scoring=table.scoring,
                    device=device,
                    hashes=hashes,
                )
            )
    return jobs


def images_hash(hashes: Hashes) -> str:
    """Of all that decides a cell's images."""
    return digest({name: getattr(hashes, name) for name in _IMAGES})


def cell_key(hashes: Hashes) -> str:
    """A cell's name: of its images' hash and its scoring's."""
    return digest([hashes.images, hashes.scoring])[:KEY_LENGTH]


def _method_hashes(method: MethodConfig, category: str) -> dict[str, str]:
    built = build_method(method)
    try:
        weights = weights_hash(built.weight_files(category))
    except Unavailable as error:
        weights = f"missing: {error}"  # once they are there, the cell is another
    return {
        "method": method_hash(method),
        "code": code_hash([inspect.getmodule(type(built)).__name__, "benchmarks.making"]),  # type: ignore[union-attr]
        "weights": weights,
    }


def _device(wanted: str) -> str:
    if wanted not in ("auto", "cpu", "cuda"):
        raise InputError(f"device={wanted} is unknown; known: auto, cpu, cuda")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise InputError("device=cuda: there is no CUDA device here; give device=cpu")
    return "cuda" if wanted != "cpu" and torch.cuda.is_available() else "cpu"
