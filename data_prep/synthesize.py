"""Synthetic categories on disk, in the layout of CO3D's second release."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from extrap_train.config import SyntheticConfig
from extrap_train.data.co3d import FRAME_ANNOTATIONS, SEQUENCE_ANNOTATIONS
from extrap_train.data.co3d.annotations import read_sequence_annotations
from extrap_train.data.co3d.writer import write_annotations, write_frame, write_sequence
from extrap_train.data.synthetic import (
    build_scene,
    handheld_orbit,
    render,
    sequence_name,
    surface_points,
    walk_seed,
)
from extrap_train.errors import InputError
from extrap_train.jobs import Died, Launcher
from extrap_train.store.atomic import (
    install_folder,
    link_target,
    partial_path,
    remove_leftovers,
    write_atomic,
)
from extrap_train.store.records import read_record, write_record
from extrap_train.terminal import track

LOOK = 2
"""Raised whenever the same options give other pictures, so that old ones are not mixed with new."""
RECORD = "synthetic.json"
"""In a sequence's folder: the options it was made with, and its annotations."""
STAMP = "synthetic_annotations.json"
"""Beside the annotations: which sequences they list, made with which options."""
CLOUD_POINTS = 20_000


@dataclass(frozen=True)
class _Record:
    """`synthetic.json`: the options that a sequence was made with, and its annotations."""

    options: dict[str, int]
    frames: list[dict[str, Any]]
    sequence: dict[str, Any]


@dataclass(frozen=True)
class _Rendering:
    """One sequence to render."""

    root: Path
    category: str
    index: int
    options: dict[str, int]

    @property
    def name(self) -> str:
        """Name of the sequence and of its folder."""
        return sequence_name(self.index)

    @property
    def folder(self) -> Path:
        """Where the sequence is to lie."""
        return self.root / self.category / self.name


def synthesize(config: SyntheticConfig, category: str, root: Path, launcher: Launcher) -> None:
    """Render the sequences of a category that `root` lacks, and annotate all that are asked for.

    Sequences 0 … `test_sequences` − 1 are the test split; asking for more training sequences keeps
    every sequence there is. Files are the same, bit for bit, with any launcher. Sequences made with
    other options are replaced, with a message. Raises InputError for an unknown category, where
    the disk is full, and, before anything is written, where anything that is not of ours lies.
    """
    options = {
        "look": LOOK,
        "seed": config.seed,
        "frames": config.frames,
        "image_size": config.image_size,
    }
    count = config.test_sequences + config.train_sequences
    jobs = [_Rendering(root, category, index, options) for index in range(count)]
    _require_ours(root / category, jobs)
    states = [_state(job) for job in jobs]
    missing = [job for job, state in zip(jobs, states, strict=True) if state != "ready"]
    _announce(category, root, states)
    _render_all(missing, launcher)
    remove_leftovers(root / category)
    records = [_read_record(job.folder) for job in jobs]
    _annotate(root, category, [record for record in records if record], config.test_sequences)


def _require_ours(folder: Path, jobs: list[_Rendering]) -> None:
    """Raise InputError where a category's folder, or one in it to be replaced, is not ours."""
    there = _entries(folder)
    made = {path.name for path in there if (path / RECORD).exists()}
    if not made and not (folder / STAMP).exists():
        foreign = there[:1]
    else:
        places = {job.folder for job in jobs}
        foreign = [path for path in there if path in places and path.name not in made]
        foreign += _foreign_annotations(folder, made)
    if foreign:
        raise InputError(
            f"{folder}: is not a folder of synthetic captures (it holds {foreign[0].name}) and "
            "is left as it is; did you mean data=co3d? Otherwise give another data.root"
        )


def _entries(folder: Path) -> list[Path]:
    """What lies in a folder by name, but for locks, what is being written, and empty folders."""
    if not folder.is_dir():
        return []
    seen = [path for path in sorted(folder.iterdir()) if not path.name.startswith(".")]
    return [path for path in seen if not path.is_dir() or any(path.iterdir())]


def _foreign_annotations(folder: Path, made: set[str]) -> list[Path]:
    """The annotations, if they list a sequence that no folder of ours stands or stood for."""
    file = folder / SEQUENCE_ANNOTATIONS
    try:
        listed = read_sequence_annotations(file)
    except InputError:  # not there yet, or damaged: written anew
        return []
    ours = made | {name for name in listed if name.isdecimal() and not (folder / name).exists()}
    return [] if ours.issuperset(listed) else [file]


def _state(job: _Rendering) -> str:
    """`ready`, `missing`, or `outdated`: made with other options."""
    if not (job.folder / RECORD).exists():
        return "missing"
    record = _read_record(job.folder)
    is_ready = (
        record is not None
        and record.options == job.options
        and len(record.frames) == job.options["frames"]
        and record.sequence.get("sequence_name") == job.name
    )
    return "ready" if is_ready else "outdated"


def _read_record(folder: Path) -> _Record | None:
    """What a sequence's folder was made with; None if that is missing or damaged."""
    try:
        return read_record(folder / RECORD, _Record, "")
    except InputError:  # rendered again
        return None


def _announce(category: str, root: Path, states: list[str]) -> None:
    if outdated := states.count("outdated"):
        print(f"{root / category}: {outdated} sequences were made with other options: made anew")
    if ready := states.count("ready"):
        print(f"{root / category}: {ready} of {len(states)} sequences are there already")


def _render_all(jobs: list[_Rendering], launcher: Launcher) -> None:
    """Renders the jobs, with a progress bar."""
    if not jobs:
        return
    done = launcher.run(_render_sequence, jobs)
    for index, result in track(done, f"rendering {jobs[0].category}", len(jobs), "sequences"):
        if isinstance(result, Died):
            raise InputError(f"{jobs[index].folder}: not rendered: {result.reason}")


def _render_sequence(job: _Rendering) -> None:
    """Render into a folder beside the final one, then rename it."""
    options = job.options
    scene = build_scene(job.category, job.index, options["seed"])
    seed = walk_seed(job.category, job.index, options["seed"])
    cameras = handheld_orbit(scene, options["frames"], options["image_size"], seed)
    place = link_target(job.folder)
    temporary = partial_path(place)
    try:
        frames = [
            write_frame(temporary, job.category, job.name, number, render(scene, cameras[number]))
            for number in range(options["frames"])
        ]
        cloud = surface_points(scene, CLOUD_POINTS)
        sequence = write_sequence(
            temporary,
            job.category,
            job.name,
            torch.from_numpy(cloud.points).float(),
            torch.from_numpy(cloud.colors).float(),
        )
        made = temporary / job.category / job.name
        write_record(made / RECORD, _Record(options, frames, sequence))
        install_folder(made, place, lambda _: _state(job) == "ready")
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _annotate(root: Path, category: str, records: list[_Record], test_sequences: int) -> None:
    """Annotation files of these sequences; left alone where they list the same ones already."""
    stamp = root / category / STAMP
    content = json.dumps([[r.sequence, r.options] for r in records] + [test_sequences])
    if (root / category / FRAME_ANNOTATIONS).exists() and _text(stamp) == content:
        return
    names = [record.sequence["sequence_name"] for record in records]
    write_annotations(
        root,
        category,
        [frame for record in records for frame in record.frames],
        [record.sequence for record in records],
        {"test": names[:test_sequences], "train": names[test_sequences:]},
    )
    write_atomic(stamp, content.encode())


def _text(path: Path) -> str | None:
    try:
        return path.read_text()
    except OSError:
        return None
