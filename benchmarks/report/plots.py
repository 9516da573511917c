"""What a table does not show: quality over the angle to the nearest input, and against time."""

import io

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.report.layout import name_of
from benchmarks.results import Results

_BIN_DEG = 20
ANGLE_METRICS = ("masked_psnr", "psnr", "lpips_squeeze", "lpips_alex")


def plots(results: Results) -> dict[str, str]:
    """SVG texts by name; a metric that no cell has is left out."""
    images = results.by_image.dropna(subset=["value"])
    drawn = {}
    for metric in ANGLE_METRICS:
        part = images[images["metric"] == metric]
        if len(part):
            drawn[f"{metric}_over_angle"] = _over_angle(part, metric, results)
    means = results.means()
    if len(means[means["metric"] == "masked_psnr"]):
        drawn["masked_psnr_over_time"] = _over_time(means, "masked_psnr", results)
    return drawn


def _over_angle(part: pd.DataFrame, metric: str, results: Results) -> str:
    """A panel a draw: on well-spread inputs targets are near, on one-sided ones far."""
    draws = list(dict.fromkeys(part["draw"]))
    figure, row = plt.subplots(
        1,
        len(draws),
        figsize=(5 * len(draws) + 1.2, 3.6),
        squeeze=False,
        sharey=True,
        layout="constrained",
    )
    for axes, draw in zip(row[0], draws, strict=True):
        chosen = part[part["draw"] == draw]
        for method, entry in results.methods.items():
            own = chosen[chosen["method"] == method]
            if len(own):
                _binned(axes, own, entry["title"] or method)
        axes.set_title(f"{draw} inputs")
        axes.set_xlabel("angle to the nearest input, degrees")
    row[0][0].set_ylabel(name_of(metric))
    _legend(figure, row[0][-1])
    return _svg(figure)


def _binned(axes: Axes, own: pd.DataFrame, label: str) -> None:
    center = (own["angle_deg"] // _BIN_DEG + 0.5) * _BIN_DEG
    groups = own["value"].groupby(center)
    mean = groups.mean()
    error = groups.std().fillna(0.0).to_numpy() / np.sqrt(groups.count().to_numpy())
    axes.errorbar(mean.index, mean, yerr=error, marker="o", markersize=4, label=label)


def _over_time(means: pd.DataFrame, metric: str, results: Results) -> str:
    """A point a method and number of views."""
    wide = means.pivot_table(index=["method", "draw", "n_views"], columns="metric", values="mean")
    figure, axes = plt.subplots(figsize=(6.2, 3.6), layout="constrained")
    for method, entry in results.methods.items():
        own = wide[wide.index.get_level_values("method") == method]
        if len(own):
            axes.plot(own["seconds"], own[metric], "o", label=entry["title"] or method)
    axes.set_xscale("log")
    axes.set_xlabel("perform time, seconds (in all, or per image: see the notes)")
    axes.set_ylabel(name_of(metric))
    _legend(figure, axes)
    return _svg(figure)


def _legend(figure: Figure, axes: Axes) -> None:
    """Beside the panels, where it hides no point."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize="small")


def _svg(figure: Figure) -> str:
    content = io.StringIO()
    with plt.rc_context({"svg.hashsalt": "table"}):  # the same bytes every time
        figure.savefig(content, format="svg", metadata={"Date": None})
    plt.close(figure)
    text = content.getvalue()
    return text[text.index("<svg") :]
