"""What a finished training run leaves behind: numbers, pictures and `summary.json`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from extrap_train.data.prepared import PreparedData
from extrap_train.diffusion.callbacks import ABOVE_BASELINES
from extrap_train.diffusion.evaluation import Prediction, missing_scores, summarise
from extrap_train.diffusion.training import CategoryTraining
from extrap_train.errors import InputError
from extrap_train.figures import draw_contact_sheet, error_map, mark_holes, plot_curve
from extrap_train.runs import RunFolder, provenance
from extrap_train.store.atomic import write_atomic
from extrap_train.store.digests import folder_digest
from extrap_train.store.records import write_summary


def write_results(
    measured: CategoryTraining,
    prepared: Sequence[PreparedData],
    missing: dict[str, str],
    seconds: dict[str, float],
    steps: int,
    folder: RunFolder,
    console: Console,
) -> None:
    """Write tables, pictures and, last of all, the summary that marks the run as finished.

    `missing` names metrics that could not be computed, with the reason; `steps` is how long the
    model was trained. Raises InputError, before anything is written, if a score that must be a
    number is none.
    """
    config, scores = measured.config, measured.scores()
    if (before := _start_scores(folder)) is not None:
        if _are_measured_alike(before, scores):
            start = before[before["method"] == "model"].assign(method="start")
            scores = pd.concat([scores, start], ignore_index=True)
        else:
            missing = missing | {"start": "was measured on other views or with another LPIPS"}
    missing = missing_scores(missing)
    _require_finite(scores, missing)
    validation = summarise(scores)
    missing = missing | _undefined(validation["model"], missing)
    write_atomic(folder.path / "validation.csv", scores.to_csv(index=False).encode())
    draw_views(measured.pictures(), folder.samples / "final.png")
    data = {each.folder.name: each.manifest["key"] for each in prepared}
    summary = {
        "validation": validation,
        "missing": missing,
        "seconds": seconds,
        "steps": steps,
        **({"model_sha256": folder_digest(folder.model)} if folder.model.is_dir() else {}),
        "parameters": sum(p.numel() for p in measured.model.parameters()),
        "provenance": {**provenance(config, data), "validation": asdict(config.validation)},
    }
    write_summary(folder.path, summary)
    console.print(_table(validation))
    for reason in dict.fromkeys(missing.values()):
        names = ", ".join(name for name in missing if missing[name] == reason)
        console.print(f"missing {names}: {reason}")


def keep_start_scores(scores: pd.DataFrame, folder: RunFolder) -> None:
    """Keep how the model of a run scores before its first step, for `write_results`; beside it how
    the nearest photographs do, which no training changes.
    """
    kept = scores[scores["method"].isin(["model", _UNCHANGED])]
    write_atomic(folder.path / _START, kept.to_csv(index=False).encode())


def _are_measured_alike(before: pd.DataFrame, now: pd.DataFrame) -> bool:
    """Whether both tables give the same views' nearest photographs the same scores, but for what
    another machine rounds.
    """
    first, second = (
        table[table["method"] == _UNCHANGED].drop(columns="method").set_index("view").sort_index()
        for table in (before, now)
    )
    return first.index.equals(second.index) and np.allclose(
        first.reindex(columns=second.columns), second, rtol=0.01, equal_nan=True
    )


def _start_scores(folder: RunFolder) -> pd.DataFrame | None:
    """What `keep_start_scores` kept; None of a run from random weights."""
    file = folder.path / _START
    if not file.is_file():
        return None
    try:
        table = pd.read_csv(file)
        table.drop(columns=["view", "method"]).astype(float)
    except (ValueError, KeyError) as error:
        raise InputError(f"{file}: damaged ({error}); delete it to go on without it") from None
    return table


def print_places(folder: RunFolder, console: Console) -> None:
    """Say where `write_results` has left what it made."""
    console.print(f"pictures: {folder.samples / 'final.png'}\nresult: {folder.path}")


_NO_OBJECT = "no held-out view shows the object"
_START = "start.csv"
_UNCHANGED = "nearest"
_WITHOUT_PIXELS = {
    "psnr_holes": "no held-out view has a pixel that no reference shows",
    "psnr_warped": "no held-out view has a pixel that a reference shows",
    "psnr_object": _NO_OBJECT,
    "psnr_object_holes": "no held-out view has a pixel of the object that no reference shows",
    "lpips_object": _NO_OBJECT,
}


def _require_finite(scores: pd.DataFrame, missing: Mapping[str, str]) -> None:
    """Scores over some of a view's pixels are undefined where there are none; others never are."""
    optional = {*_WITHOUT_PIXELS, *missing}
    for name in scores.columns.difference(["method", "view", *optional]):
        odd = scores[~np.isfinite(scores[name])]
        if len(odd):
            method, view = odd.iloc[0][["method", "view"]]
            raise InputError(
                f"{name} of {method} is not a number in {len(odd)} held-out views (first: {view}): "
                "lower model.learning_rate, or sample with other options under sampler"
            )


def _undefined(means: dict[str, float], missing: dict[str, str]) -> dict[str, str]:
    """Why a metric has no mean, where that is not a fault."""
    return {
        name: reason
        for name, reason in _WITHOUT_PIXELS.items()
        if name in means and math.isnan(means[name]) and name not in missing
    }


def draw_views(prediction: Prediction, path: Path) -> None:
    """Reference, warp, output, truth and error, a row per view, named as in `validation.csv`."""
    batch, images = prediction.batch, prediction.images
    assert batch.warp is not None
    draw_contact_sheet(
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
    if ABOVE_BASELINES in table:
        rows = table[table[ABOVE_BASELINES].notna()]
        series = {"model": rows[ABOVE_BASELINES].tolist(), "best baseline": [0.0] * len(rows)}
        path = folder.samples / "curve.png"
        plot_curve(rows["step"].tolist(), series, "PSNR above the best baseline, dB", path)


def _table(validation: dict[str, dict[str, float]]) -> Table:
    metrics = [name for name, mean in validation["model"].items() if math.isfinite(mean)]
    table = Table(title="held-out views", padding=(0, 1, 0, 0))
    table.add_column(no_wrap=True)
    for metric in metrics:
        table.add_column(metric.replace("_", " "))
    for method, row in validation.items():
        table.add_row(method, *(f"{row[metric]:.3f}" for metric in metrics))
    return table
