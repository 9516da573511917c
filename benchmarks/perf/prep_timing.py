"""Preparation: where a frame's time goes on one core, and two workers against one."""

import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numba
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.perf.timing import Row, compare
from data_prep.correct import correct_pair, draw
from data_prep.pairs import choose_pairs
from data_prep.preparation import prepare
from data_prep.synthesize import synthesize
from extrap_train.config import FlowMatcherConfig, PrepConfig, StereoConfig, SyntheticConfig
from extrap_train.data import sequences as captures
from extrap_train.data.co3d import read_category
from extrap_train.data.frame_files import (
    StoredFrames,
    frames_folder,
    read_camera_table,
    write_frames,
)
from extrap_train.data.square_frames import make_frames
from extrap_train.depth import DepthMap, DepthSource
from extrap_train.depth.stereo import PlaneSweepStereo
from extrap_train.jobs import Launcher
from extrap_train.jobs.local import LocalLauncher
from extrap_train.matching import Matches
from extrap_train.matching.dense_flow import FlowMatcher
from extrap_train.views import View

CATEGORY = "hydrant"
DATA = SyntheticConfig(test_sequences=1, train_sequences=5, frames=12)
OPTIONS = PrepConfig(full_circle="ignore")
STEREO, MATCHER = PlaneSweepStereo(StereoConfig()), FlowMatcher(FlowMatcherConfig())
ONE_WARP = "(one warp of each pair)"
"""Timed apart: correction draws up to four."""
_REPEATS = 2
"""A round takes minutes."""


@dataclass(frozen=True)
class _Clock:
    """Seconds of this process's cores by what they were spent on: others' work does not count."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def on(self, what: str) -> Iterator[None]:
        start = time.process_time()
        yield
        self.seconds[what] = self.seconds.get(what, 0.0) + time.process_time() - start


@dataclass(frozen=True)
class _TimedStereo(PlaneSweepStereo):
    clock: _Clock

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        with self.clock.on("stereo"):
            return super().depth_maps(views)


@dataclass(frozen=True)
class _TimedMatcher:
    clock: _Clock

    def match(
        self,
        first: Float[Tensor, "3 h w"],
        second: Float[Tensor, "3 h2 w2"],
        first_known: Bool[Tensor, "h w"] | None = None,
    ) -> Matches:
        with self.clock.on("matching"):
            return MATCHER.match(first, second, first_known)


def run() -> list[Row]:
    """Prints where the time goes; a row for two workers against one, each of one thread."""
    folder = Path(tempfile.mkdtemp())
    threads = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    try:
        with LocalLauncher(1, apart=True) as one, LocalLauncher(2) as two:
            synthesize(DATA, CATEGORY, folder / "captures", two)
            sequences = read_category(folder / "captures", CATEGORY)
            for line in table_of(*stages(sequences[-1], folder)):
                print(line)
            return [_two_against_one(sequences, one, two, folder)]
    finally:
        torch.set_num_threads(threads[0])
        numba.set_num_threads(threads[1])
        shutil.rmtree(folder)


def stages(sequence: captures.Sequence, folder: Path) -> tuple[dict[str, float], int, int]:
    """Seconds by stage, and the frames and training pairs, of a sequence that is prepared twice.

    The first time warms up what is compiled or loaded on first use.
    """
    for _ in range(2):
        clock = _Clock()
        with clock.on("reading and stereo"):
            stereo: DepthSource = _TimedStereo(STEREO.config, clock)
            frames = make_frames(sequence, stereo, OPTIONS.image_size, lone=False)
        place = frames_folder(folder, f"{sequence.category}/{sequence.name}")
        with clock.on("storing"):
            write_frames(place, frames, "timed")
        table = read_camera_table(place, "timed")
        assert table is not None
        stored = StoredFrames.open(place, table)
        with clock.on("choosing pairs"):
            pairs = choose_pairs(stored, sequence.name, "train", OPTIONS)
        _correct(stored, list(zip(pairs["reference"], pairs["query"], strict=True)), clock)
    spent = clock.seconds
    seconds = {
        "reading": spent["reading and stereo"] - spent["stereo"],
        "stereo": spent["stereo"],
        "storing": spent["storing"],
        "choosing pairs": spent["choosing pairs"],
        "matching": spent["matching"],
        "fitting, warping, judging": spent["correction"] - spent["matching"],
        ONE_WARP: spent[ONE_WARP],
    }
    return seconds, len(frames.names), len(pairs)


@torch.inference_mode()
def _correct(stored: StoredFrames, pairs: list[tuple[int, int]], clock: _Clock) -> None:
    for reference, query in pairs:
        image, depth, truth = stored.image(reference), stored.depth(reference), stored.image(query)
        cameras = stored.camera[reference], stored.camera[query]
        with clock.on(ONE_WARP):
            draw(image, depth, *cameras)
        with clock.on("correction"):
            correct_pair(
                image,
                depth,
                cameras[0],
                truth,
                cameras[1],
                _TimedMatcher(clock),
                OPTIONS.correction_grid,
            )


def table_of(seconds: dict[str, float], frames: int, pairs: int) -> list[str]:
    """Lines of a table with milliseconds of one core."""
    total = sum(spent for what, spent in seconds.items() if what != ONE_WARP)
    lines = [
        f"{frames} frames, {pairs} pairs",
        "stage                       ms a frame  frames/s  share",
    ]
    for what, spent in [*seconds.items(), ("all", total)]:
        each = spent / frames
        lines.append(f"{what:<26}{1e3 * each:12.1f}{1 / each:10.1f}{spent / total:7.0%}")
    return lines


def _two_against_one(
    sequences: Sequence[captures.Sequence], one: Launcher, two: Launcher, folder: Path
) -> Row:
    def errors(launcher: Launcher) -> Float[Tensor, " m"]:
        """What a preparation from nothing finds for every pair."""
        output = Path(tempfile.mkdtemp(dir=folder))
        data = prepare(
            sequences,
            STEREO,
            OPTIONS,
            test_names=DATA.test_sequences,
            folder=output,
            matcher=MATCHER,
            launcher=launcher,
            progress=False,
        )
        found = torch.tensor(data.pairs("train").error_after)
        shutil.rmtree(output)
        return found.nan_to_num()

    return compare(
        f"{len(sequences)} sequences of {DATA.frames} frames, two workers against one",
        torch.device("cpu"),
        lambda: errors(two),
        lambda: errors(one),
        _REPEATS,
    )
