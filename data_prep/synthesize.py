"""Synthetic categories on disk, in the layout of CO3D's second release."""

import json
import multiprocessing
import os
import shutil
import threading
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from extrap_train.config import SyntheticConfig
from extrap_train.data.co3d import FRAME_ANNOTATIONS
from extrap_train.data.co3d_writer import write_annotations, write_frame, write_sequence
from extrap_train.data.files import write_whole
from extrap_train.data.synthetic import (
    build_scene,
    handheld_orbit,
    render,
    sequence_name,
    surface_points,
    walk_seed,
)

LOOK = 2
"""Raised whenever the same options give other pictures, so that old ones are not mixed with new."""
RECORD = "synthetic.json"
"""In a sequence's folder: the options it was made with, and its annotations."""
CLOUD_POINTS = 20_000


@dataclass(frozen=True)
class _Job:
    """One sequence to render."""

    category: str
    index: int
    options: dict[str, int]

    @property
    def name(self) -> str:
        """The sequence's folder."""
        return sequence_name(self.index)


def synthesize(config: SyntheticConfig, category: str, root: Path, workers: int) -> None:
    """Render the sequences of a category that `root` lacks, and annotate all that are asked for.

    Sequences 0 … `test_sequences` − 1 are the test split; asking for more training sequences keeps
    every sequence there is. Files are the same, bit for bit, for any number of `workers`. Sequences
    made with other options are replaced, with a message. Raises InputError for an unknown category
    and where the disk is full.
    """
    options = {
        "look": LOOK,
        "seed": config.seed,
        "frames": config.frames,
        "image_size": config.image_size,
    }
    count = config.test_sequences + config.train_sequences
    jobs = [_Job(category, index, options) for index in range(count)]
    states = [_state(root, job) for job in jobs]
    missing = [job for job, state in zip(jobs, states, strict=True) if state != "ready"]
    _announce(category, root, states)
    _render_all(missing, root, workers)
    records = [_read_record(root / category / job.name) for job in jobs]
    _annotate(root, category, [record for record in records if record], config.test_sequences)


def _state(root: Path, job: _Job) -> str:
    """`ready`, `missing`, or `outdated`: made with other options."""
    folder = root / job.category / job.name
    if not folder.exists():
        return "missing"
    record = _read_record(folder)
    return "ready" if record is not None and record["options"] == job.options else "outdated"


def _read_record(folder: Path) -> dict[str, Any] | None:
    try:
        record = json.loads((folder / RECORD).read_bytes())
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) and "options" in record else None


def _announce(category: str, root: Path, states: list[str]) -> None:
    if outdated := states.count("outdated"):
        print(f"{root / category}: {outdated} sequences were made with other options: made anew")
    if ready := states.count("ready"):
        print(f"{root / category}: {ready} of {len(states)} sequences are there already")


def _render_all(jobs: list[_Job], root: Path, workers: int) -> None:
    """Renders the jobs in up to `workers` processes, with a progress bar."""
    if not jobs:
        return
    label = f"render {jobs[0].category}"
    if workers <= 1 or len(jobs) == 1:
        for job in tqdm(jobs, label, unit="sequence"):
            _render_sequence(root, job)
        return
    # Spawned, not forked: the parent may hold threads and a GPU.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        min(workers, len(jobs)),
        mp_context=context,
        initializer=_prepare_worker,
    ) as pool:
        futures = [pool.submit(_render_sequence, root, job) for job in jobs]
        try:
            for future in tqdm(as_completed(futures), label, len(jobs), unit="sequence"):
                future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _prepare_worker() -> None:
    """One thread a worker, and no worker without its parent: a killed run leaves none behind."""
    torch.set_num_threads(1)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _render_sequence(root: Path, job: _Job) -> None:
    """Render into a folder beside the final one, then rename it."""
    options = job.options
    scene = build_scene(job.category, job.index, options["seed"])
    seed = walk_seed(job.category, job.index, options["seed"])
    cameras = handheld_orbit(scene, options["frames"], options["image_size"], seed)
    workshop = root / job.category / f".{job.name}.{os.getpid()}"
    try:
        frames = [
            write_frame(workshop, job.category, job.name, number, render(scene, cameras[number]))
            for number in range(options["frames"])
        ]
        cloud = surface_points(scene, CLOUD_POINTS)
        sequence = write_sequence(
            workshop,
            job.category,
            job.name,
            torch.from_numpy(cloud.points).float(),
            torch.from_numpy(cloud.colors).float(),
        )
        made = workshop / job.category / job.name
        record = {"options": options, "frames": frames, "sequence": sequence}
        write_whole(made / RECORD, json.dumps(record).encode())
        final = root / job.category / job.name
        if final.exists():
            shutil.rmtree(final)
        made.rename(final)
    finally:
        shutil.rmtree(workshop, ignore_errors=True)


def _annotate(
    root: Path, category: str, records: list[dict[str, Any]], test_sequences: int
) -> None:
    """Annotation files of these sequences; left alone where they list the same ones already."""
    stamp = root / category / "synthetic_annotations.json"
    content = json.dumps([[r["sequence"], r["options"]] for r in records] + [test_sequences])
    if (root / category / FRAME_ANNOTATIONS).exists() and _text(stamp) == content:
        return
    names = [record["sequence"]["sequence_name"] for record in records]
    write_annotations(
        root,
        category,
        [frame for record in records for frame in record["frames"]],
        [record["sequence"] for record in records],
        {"test": names[:test_sequences], "train": names[test_sequences:]},
    )
    write_whole(stamp, content.encode())


def _text(path: Path) -> str | None:
    try:
        return path.read_text()
    except OSError:
        return None
