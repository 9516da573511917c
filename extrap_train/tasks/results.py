"""What a finished training run leaves behind: numbers, pictures and `summary.json`."""

import io
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from extrap_train.config import TrainConfig
from extrap_train.diffusion.evaluation import Prediction, summarise
from extrap_train.errors import InputError
from extrap_train.pictures import contact_sheet, curve, error_map, mark_holes
from extrap_train.runs import RunFolder
from extrap_train.store.atomic import write_atomic
from extrap_train.store.records import write_summary

_ABOVE = "validation/above_baselines_db"


@dataclass(frozen=True)
class Results:
    """What training and validation found."""

    scores: pd.DataFrame
    """One row per held-out view and method."""
    shown: Prediction
    """The views for the picture sheet."""
    missing: dict[str, str]
    """Metrics that could not be computed, with the reason."""
    seconds: dict[str, float]
    """Of the last session of the run: prepare, train, validate."""
    steps: int
    parameters: int
    provenance: dict[str, Any]


def write_results(
    results: Results, config: TrainConfig, folder: RunFolder, console: Console
) -> None:
    """Write tables, pictures and, last of all, the summary that marks the run as finished.

    Raises InputError, before anything is written, if a score that must be a number is none.
    """
    _require_finite(results)
    validation = summarise(results.scores)
    missing = results.missing | _undefined(validation["model"], results.missing)
    text = io.StringIO()
    results.scores.to_csv(text, index=False)
    write_atomic(folder.path / "validation.csv", text.getvalue().encode())
    draw_views(results.shown, folder.samples / "final.png")
    summary = {
        "validation": validation,
        "missing": missing,
        "seconds": results.seconds,
        "steps": results.steps,
        "parameters": results.parameters,
        "provenance": {**results.provenance, "validation": asdict(config.validation)},
    }
    write_summary(folder.path, summary)
    console.print(_table(validation))
    for name, reason in missing.items():
        console.print(f"missing {name}: {reason}")
    console.print(f"pictures: {folder.samples / 'final.png'}\nresult: {folder.path}")


_WITHOUT_PIXELS = {
    "psnr_holes": "no held-out view has a pixel that no reference shows",
    "psnr_warped": "no held-out view has a pixel that a reference shows",
}


def _require_finite(results: Results) -> None:
    """Scores over some of a view's pixels are undefined where there are none; others never are."""
    optional = {*_WITHOUT_PIXELS, *results.missing}
    for name in results.scores.columns.difference(["method", "view", *optional]):
        odd = results.scores[~np.isfinite(results.scores[name])]
        if len(odd):
            method, view = odd.iloc[0][["method", "view"]]
            raise InputError(
                f"{name} of {method} is not a number in {len(odd)} held-out views (first: {view}): "
                "lower model.learning_rate, or sample with other options under sampler"
            )


def _undefined(means: dict[str, float], missing: dict[str, str]) -> dict[str, str]:
    """Why a metric has no mean, where that is no fault."""
    return {
        name: reason
        for name, reason in _WITHOUT_PIXELS.items()
        if name in means and math.isnan(means[name]) and name not in missing
    }


def draw_views(prediction: Prediction, path: Path) -> None:
    """Reference, warp, output, truth and error, a row per view, named as in `validation.csv`."""
    batch, images = prediction.batch, prediction.images
    assert batch.warp is not None
    contact_sheet(
        {
            "reference": images["nearest"],
            "warp": mark_holes(batch.warp.image, batch.warp.mask),
            "inpainted": images["inpainted"],
            "model": images["model"],
            "truth": batch.image,
            "error": error_map(images["model"], batch.image),
        },
        path,
        prediction.names,
    )


def draw_curve(folder: RunFolder) -> None:
    """How far the model was above the best baseline, over the training steps."""
    table = pd.read_csv(folder.path / "metrics.csv")
    if _ABOVE in table:
        rows = table[table[_ABOVE].notna()]
        series = {"model": rows[_ABOVE].tolist(), "best baseline": [0.0] * len(rows)}
        path = folder.samples / "curve.png"
        curve(rows["step"].tolist(), series, "PSNR above the best baseline, dB", path)


def _table(validation: dict[str, dict[str, float]]) -> Table:
    metrics = list(next(iter(validation.values())))
    table = Table("", *metrics, title="held-out views")
    for method, row in validation.items():
        table.add_row(method, *(f"{row[metric]:.3f}" for metric in metrics))
    return table
