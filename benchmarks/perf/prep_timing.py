"""Preparation of a category from nothing: two workers against one, each of one thread."""

import shutil
import tempfile
from pathlib import Path

import numba
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.perf.timing import Timing, compare
from data_prep.preparation import prepare
from data_prep.synthesize import synthesize
from extrap_train.config import FlowMatcherConfig, PrepConfig, StereoConfig, SyntheticConfig
from extrap_train.data.co3d import read_category
from extrap_train.depth.stereo import PlaneSweepStereo
from extrap_train.jobs import Launcher
from extrap_train.jobs.local import LocalLauncher
from extrap_train.matching.dense_flow import FlowMatcher

CATEGORY = "hydrant"
DATA = SyntheticConfig(test_sequences=1, train_sequences=5, frames=12)
OPTIONS = PrepConfig(full_circle="ignore")
STEREO, MATCHER = PlaneSweepStereo(StereoConfig()), FlowMatcher(FlowMatcherConfig())
_REPEATS = 2
"""A round takes minutes."""


def run() -> list[Timing]:
    """The row of two workers against one; they must find the same errors."""
    folder = Path(tempfile.mkdtemp())
    threads = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    try:
        with LocalLauncher(1) as one, LocalLauncher(2) as two:
            synthesize(DATA, CATEGORY, folder / "captures", two)
            sequences = read_category(folder / "captures", CATEGORY)

            def errors(launcher: Launcher) -> Float[Tensor, " m"]:
                """The error of every pair that a preparation from nothing finds."""
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

            case = f"{len(sequences)} sequences of {DATA.frames} frames, two workers against one"
            cpu = torch.device("cpu")
            return [compare(case, cpu, lambda: errors(two), lambda: errors(one), _REPEATS)]
    finally:
        torch.set_num_threads(threads[0])
        numba.set_num_threads(threads[1])
        shutil.rmtree(folder)
