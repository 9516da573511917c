"""Memory hardly grows with the number of sequences: of reading, of a job, of a whole run.

`python -m pytest -s -m slow tests/data_prep/test_memory_of_preparation.py` prepares ten thousand
sequences.
"""

import gzip
import json
import pickle
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from captures import frame_entries, write_capture

from data_prep.model_cache import PrepModels
from data_prep.sequence_job import PrepContext, SequenceJob
from extrap_train.config import DatasetDepthConfig, PrepConfig
from extrap_train.data import co3d, json_files
from extrap_train.data.co3d import read_category
from extrap_train.data.sequences import FrameSequence

FRAMES = 20
MAX_BYTES_A_FRAME = 1000
"""Seven thousand was what a frame took as JSON, or as a camera of its own."""
MANY = 10_000
MAX_BYTES = 2 * 2**30


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One sequence of pictures of 8 x 16 pixels, whose files all others share."""
    root = tmp_path_factory.mktemp("co3d")
    write_capture(root, ("one",), FRAMES, size=8, step_deg=360 / FRAMES)
    return root


def annotate(root: Path, count: int) -> None:
    """Annotations of `count` sequences, all of the same photographs."""
    frames = frame_entries(root)[:FRAMES]
    names = [f"s{index:05d}" for index in range(count)]
    write_list(
        root / "cup" / "frame_annotations.jgz",
        (frame | {"sequence_name": name} for name in names for frame in frames),
    )
    write_list(
        root / "cup" / "sequence_annotations.jgz",
        ({"sequence_name": name, "category": "cup"} for name in names),
    )


def write_list(file: Path, entries: Iterator[dict[str, Any]]) -> None:
    with gzip.open(file, "wt", compresslevel=1) as stream:
        stream.write("[" + json.dumps(next(entries)))
        stream.writelines(", " + json.dumps(entry) for entry in entries)
        stream.write("]")


def test_what_is_kept_of_a_frame_is_small(
    photographs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(co3d, "_ENTRIES_AT_A_TIME", 100)
    monkeypatch.setattr(json_files, "_PIECE_BYTES", 10_000)
    read_category(photographs, "cup")  # what is imported and cached, once
    peaks = []
    for count in (10, 30):
        annotate(photographs, count)
        tracemalloc.start()
        sequences = read_category(photographs, "cup")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert len(sequences) == count
    slope = (peaks[1] - peaks[0]) / (20 * FRAMES)
    print(f"reading takes {slope:.0f} bytes a frame")
    assert slope < MAX_BYTES_A_FRAME


def test_a_job_takes_its_own_sequence_along_and_no_other(photographs: Path) -> None:
    shop = PrepContext(
        PrepModels(DatasetDepthConfig(), None), PrepConfig(), photographs, photographs
    )

    def job(sequences: list[FrameSequence]) -> int:
        return len(pickle.dumps(SequenceJob(shop, sequences[0], "train", "key")))

    annotate(photographs, 2)
    few = job(read_category(photographs, "cup"))
    annotate(photographs, 50)
    assert job(read_category(photographs, "cup")) == few < MAX_BYTES_A_FRAME * FRAMES


@pytest.mark.slow
def test_ten_thousand_sequences_stay_within_two_gibibytes(
    photographs: Path, tmp_path: Path
) -> None:
    peaks = {}
    for count in (MANY // 10, MANY):
        annotate(photographs, count)
        peaks[count] = peak_bytes(photographs, tmp_path / str(count))
        print(f"{count} sequences of {FRAMES} frames, MiB: {peaks[count]}")
    assert peaks[MANY]["all"] < MAX_BYTES >> 20
    # Its share of pages that are mapped from files hangs on what else runs on the machine.
    assert peaks[MANY]["worker_heap"] < 1.05 * peaks[MANY // 10]["worker_heap"]


def peak_bytes(photographs: Path, output: Path) -> dict[str, int]:
    """Most memory in MiB of a preparation with two workers; shared pages are counted in parts, but
    not in a worker's heap.
    """
    options = ["category=cup", "data=co3d", f"data.root={photographs}", f"output={output}"]
    tiny = ["prep.image_size=8", "prep.correct=false", "workers=2"]
    command = [sys.executable, "-m", "data_prep", *options, *tiny]
    said = output.with_suffix(".log")
    with said.open("w") as log:
        run = subprocess.Popen(command, stdout=log, stderr=log)
    peaks: dict[str, int] = {}
    while run.poll() is None:
        children = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
        own, workers = memory_mib(run.pid), [memory_mib(int(child)) for child in children]
        now = {
            "parent": own["Pss"],
            "worker": max((each["Pss"] for each in workers), default=0),
            "worker_heap": max((each["Anonymous"] for each in workers), default=0),
            "all": own["Pss"] + sum(each["Pss"] for each in workers),
        }
        peaks = {who: max(peaks.get(who, 0), value) for who, value in now.items()}
        time.sleep(0.5)
    assert run.returncode == 0, said.read_text()[-2000:]
    return peaks


def memory_mib(pid: int) -> dict[str, int]:
    """A process's proportional share of resident memory, and what of it no file holds; 0 once it
    has ended.
    """
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    except OSError:
        return {"Pss": 0, "Anonymous": 0}
    return {name: int(text.split(f"{name}:")[1].split()[0]) >> 10 for name in ("Pss", "Anonymous")}
