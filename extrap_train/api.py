"""What a program does with a scene, a model or a table; `extrap_train` exports it lazily."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import torch

from extrap_train.cli import TRAIN, compose_config
from extrap_train.config import (
    DatasetDepthConfig,
    DepthConfig,
    ModelConfig,
    SamplerConfig,
    TrainerConfig,
)
from extrap_train.data.examples import query_batch
from extrap_train.data.scene_spec import open_scene
from extrap_train.data.square_frames import input_views, select_input_frames
from extrap_train.depth import DatasetDepth
from extrap_train.depth.sources import depth_source
from extrap_train.device import fastest_device
from extrap_train.diffusion.generator import DiffusionGenerator
from extrap_train.gaussians.fit import fit_views
from extrap_train.gaussians.gaussian_model import Gaussians
from extrap_train.gaussians.gaussian_options import GaussianOptions
from extrap_train.geometry.warp import compute_warp
from extrap_train.tasks import complete
from extrap_train.tasks.scene_model import open_model
from extrap_train.views import Camera, View, Warp, stack_cameras


def open_views(
    scene: str, inputs: int | None = None, depth: DepthConfig | None = None, *, size: int = 128
) -> list[View]:
    """A scene's square views with depth: `inputs` of them, spread around the scene, or all.

    `scene` is what `scene=` takes on the command line. `size` is the side of the views in pixels;
    the packaged models warp from 128. `depth` defaults to the data set's own; `StereoConfig()`
    estimates it. Raises InputError where the scene cannot be read or depth cannot be had.
    """
    sequence = open_scene(scene)
    chosen = select_input_frames(sequence, (), inputs)
    return input_views(sequence, chosen, depth_source(depth or DatasetDepthConfig()), size)


def warp_view(
    views: Sequence[View], camera: Camera, *, size: int = 128, most_views: int = 3
) -> Warp:
    """What views with depth show from another camera: colour, depth, and a mask of what is known.

    The result is a batch of one, a square of `size` pixels, warped from the `most_views` views that
    stand nearest. Raises InputError for degenerate cameras and for views without depth.
    """
    batch, _ = query_batch(views, stack_cameras([camera]), most_views, size)
    warp = compute_warp(batch, size).warp
    assert warp is not None
    return warp


def open_generator(
    weights: str,
    adapter: str | None = None,
    sampler: SamplerConfig | None = None,
    config: ModelConfig | None = None,
    *,
    device: torch.device | str | None = None,
    precision: str = TrainerConfig.precision,
) -> DiffusionGenerator:
    """The generator of a model folder, of a packaged model, or of a published checkpoint.

    `config` describes a published checkpoint; without it, family and size are recognised by the
    tensors. Without `sampler` it samples as the model recommends. It runs where and in what the
    commands do: on the GPU where there is one, in bfloat16 where the processor has units for it.
    Raises InputError for weights that cannot be used.
    """
    model = open_model(weights, adapter, config).to(device or fastest_device())
    return DiffusionGenerator(model, sampler or model.config.sampler, precision=precision)


def fit_gaussians(views: Sequence[View], *, iterations: int = 500, seed: int = 0) -> Gaussians:
    """Plain 3DGS of views that have depth, from whose points it starts; `write_splats` saves it.

    Raises InputError for views that cannot be used, `Diverged` where fitting fails.
    """
    options = GaussianOptions(iterations=iterations, init="dense")
    return fit_views(views, DatasetDepth(), options, seed).gaussians()


def complete_scene(
    scene: str, category: str, *, inputs: int | None = None, options: Sequence[str] = ()
) -> Path:
    """Complete a scene as `task=complete` does; returns the folder of its result.

    `options` are words of the command line, as `depth=stereo` or `output=FOLDER`. A second call
    resumes or reuses what is there. Raises InputError for anything that cannot be used.
    """
    words = ["task=complete", f"category={category}", f"scene={scene}", *options]
    words += [] if inputs is None else [f"inputs={inputs}"]
    return complete.run(compose_config(TRAIN, words)).folder


def score_method(
    method: str,
    table: str = "table1",
    *,
    quick: bool = False,
    options: Sequence[str] = (),
    config_dirs: Sequence[str] = (),
) -> pd.DataFrame:
    """Mean scores of one method on a table's captures, as `benchmark run` measures them.

    One row per draw, number of inputs and metric, with the bounds of its interval. `options` are
    words of the command line, as `output=FOLDER`; `config_dirs` are folders of your own with
    methods or tables. Cells that are there are reused.
    """
    from benchmarks.catalogue import Catalogue
    from benchmarks.report.aggregate import read_results
    from benchmarks.run.plan import TableFolder
    from benchmarks.run_table import RunOptions, run_table

    catalogue = Catalogue.with_own(config_dirs)
    chosen = catalogue.table(table, [*options, f"methods=[{method}]"])
    catalogue.check(chosen)
    run_table(chosen, catalogue, RunOptions(quick))
    return read_results(TableFolder(Path(chosen.output) / chosen.name)).means()
