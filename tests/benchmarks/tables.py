"""A small table of one's own, as a third party writes it: one file, and a YAML a method."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest

from benchmarks.catalogue import Catalogue
from benchmarks.run.plan import TableFolder
from benchmarks.run_table import RunOptions, run_table
from extrap_train.jobs import Launcher

_METHOD = '''
import os
from dataclasses import dataclass

import torch

from benchmarks.methods.base import Stopwatch, Synthesis, Unavailable


@dataclass(frozen=True)
class Grey:
    """Generates every target in one grey."""

    level: float = 0.5
    trouble: str = ""

    def weight_files(self, category):
        return ()

    def synthesize(self, inputs):
        if self.trouble == "raise":
            raise RuntimeError("no luck")
        if self.trouble == "unavailable":
            raise Unavailable("no weights: grey.bin is missing")
        if self.trouble == "kill":
            os.kill(os.getpid(), 9)
        if self.trouble == "range":
            self_range = 2.0
        else:
            self_range = 1.0
        count = len(inputs.targets.world_to_cam)
        size = (inputs.targets.height, inputs.targets.width)
        with Stopwatch() as watch:
            images = torch.full((count, 3, *size), self.level * self_range)
        points = torch.zeros(5, 3) if self.trouble == "points" else None
        return Synthesis(images, watch.seconds, {"init": "none"}, points, {"greys": 1.0})
'''
_TABLE = """
title: Greys
captures:
  source: synthetic
  categories: [apple]
  sequences: 2
  frames: 10
  render_size: 24
rules:
  image_size: 24
  depth: dataset
  views: [3]
methods: [dark, light]
columns: [psnr, masked_psnr, lpips_alex, seconds]
scoring:
  dists: false
quick:
  sequences: 1
reported: table1
"""
METHODS = {"dark": (0.2, ""), "light": (0.6, ""), "broken": (0.5, "raise")}
METHODS |= {"absent": (0.5, "unavailable"), "killer": (0.5, "kill"), "bright": (1.0, "range")}
METHODS |= {"solid": (0.4, "points")}


def write_own(folder: Path) -> Path:
    """The folder that `--config-dir` takes."""
    (folder / "method").mkdir(parents=True)
    (folder / "table").mkdir()
    (folder / "grey_method.py").write_text(_METHOD)
    for name, (level, trouble) in METHODS.items():
        (folder / "method" / f"{name}.yaml").write_text(
            f"title: {name}\nfactory: grey_method.Grey\n"
            f"options: {{level: {level}, trouble: '{trouble}'}}\n"
        )
    (folder / "table" / "greys.yaml").write_text(_TABLE)
    return folder


@contextmanager
def without_plots() -> Iterator[None]:
    """Drawing takes longer than all other reports of a small table."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.report.plots", lambda results: {})
        yield


def run_greys(
    own: Path,
    output: Path,
    *overrides: str,
    launcher: Launcher | None = None,
    draws: bool = False,
    **options: object,
) -> int:
    """Run the table, one cell after another unless there is a launcher; it `draws` no plots unless
    asked to.
    """
    catalogue = Catalogue.with_own([str(own)])
    table = catalogue.table("greys", [f"output={output}", *overrides])
    run = RunOptions(**{"workers": 1, "launcher": launcher, **options})  # type: ignore[arg-type]
    with nullcontext() if draws else without_plots():
        return run_table(table, catalogue, run)


def greys_folder(output: Path) -> TableFolder:
    return TableFolder(output / "greys")
