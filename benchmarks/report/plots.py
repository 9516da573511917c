"""What a table does not show: quality over the angle to the nearest input, and against time."""

import io
from itertools import product
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.report.aggregate import CAPTURE, Results
from benchmarks.report.table_layout import name_of
from benchmarks.run.cells import one_line

_BIN_DEG = 20
_ASIDE_DEG = 0.7
"""Between two methods' points of one interval, so that no error bar hides another."""
ANGLE_METRICS = ("masked_psnr", "psnr", "lpips_squeeze", "lpips_alex")


def plots(results: Results) -> dict[str, str]:
    """SVG texts by name; a metric that no cell has is left out."""
    images, means, drawn = results.by_image.dropna(subset=["value"]), results.means(), {}
    with plt.rc_context({"text.parse_math": False, "svg.hashsalt": "table"}):  # the same bytes
        for metric in ANGLE_METRICS:
            part = images[images["metric"] == metric]
            if len(part):
                drawn[f"{metric}_over_angle"] = _over_angle(part, metric, results)
        if len(means[means["metric"] == "masked_psnr"]):
            drawn["masked_psnr_over_time"] = _over_time(means, "masked_psnr", results)
    return drawn


def _over_angle(part: pd.DataFrame, metric: str, results: Results) -> str:
    """One panel per draw and number of views, which angles go with: more inputs are nearer to all
    targets, and so are well-spread ones.
    """
    draws, views = list(dict.fromkeys(part["draw"])), sorted(set(part["n_views"]))
    figure, grid = plt.subplots(
        len(views),
        len(draws),
        figsize=(5 * len(draws) + 1.2, 3 * len(views) + 0.6),
        squeeze=False,
        sharex=True,
        sharey=True,
        layout="constrained",
    )
    for (n_views, draw), axes in zip(product(views, draws), grid.flat, strict=True):
        chosen = part[(part["draw"] == draw) & (part["n_views"] == n_views)]
        for index, (method, entry) in enumerate(results.methods.items()):
            own = binned(chosen[chosen["method"] == method])
            aside = (index - (len(results.methods) - 1) / 2) * _ASIDE_DEG
            _draw_curve(axes, own, aside, f"C{index}", one_line(entry.title or method))
        _draw_capture_counts(axes, chosen)
        axes.set_title(f"{one_line(draw)} inputs, {n_views} views", fontsize="medium")
    for axes in grid[-1]:
        axes.set_xlabel("angle to the nearest input, degrees")
    for axes in grid[:, 0]:
        axes.set_ylabel(name_of(metric))
    _draw_legend(figure)
    return _svg(figure)


def binned(images: pd.DataFrame) -> pd.DataFrame:
    """One row per interval of angles, by its `center`: mean over captures, its standard error (NaN
    for a single one) and the count of `captures`. Images of one capture do not count as samples.
    """
    center = ((images["angle_deg"] // _BIN_DEG + 0.5) * _BIN_DEG).rename("center")
    by_capture = images["value"].groupby([center, *(images[name] for name in CAPTURE)]).mean()
    groups = by_capture.groupby(level="center")
    return pd.DataFrame({"mean": groups.mean(), "error": groups.sem(), "captures": groups.count()})


def _draw_curve(axes: Axes, own: pd.DataFrame, aside: float, color: str, label: str) -> None:
    """Hollow where a single capture is all there is."""
    if own.empty:
        return
    at = own.index.to_numpy() + aside
    axes.errorbar(at, own["mean"], yerr=own["error"], color=color, marker="o", ms=4, label=label)
    single = (own["captures"] == 1).to_numpy()
    axes.plot(at[single], own["mean"][single], "o", ms=4, mec=color, mfc="white", zorder=3)


def _draw_capture_counts(axes: Axes, images: pd.DataFrame) -> None:
    """How many captures have a target at such angles, along the lower edge."""
    captures = binned(images)["captures"]
    for center, count in zip(captures.index.to_numpy(), captures, strict=True):
        axes.text(
            center,
            0.01,
            str(count),
            transform=axes.get_xaxis_transform(),
            ha="center",
            va="bottom",
            color="gray",
            fontsize="x-small",
        )


def _over_time(means: pd.DataFrame, metric: str, results: Results) -> str:
    """One point per method and number of views."""
    wide = means.pivot_table(index=["method", "draw", "n_views"], columns="metric", values="mean")
    figure, axes = plt.subplots(figsize=(6.2, 3.6), layout="constrained")
    for index, (method, entry) in enumerate(results.methods.items()):
        own = wide[wide.index.get_level_values("method") == method]
        if len(own):
            label = one_line(entry.title or method)
            axes.plot(own["seconds"], own[metric], "o", color=f"C{index}", label=label)
    axes.set_xscale("log")
    axes.set_xlabel("perform time, seconds (in all, or per image: see the notes)")
    axes.set_ylabel(name_of(metric))
    _draw_legend(figure)
    return _svg(figure)


def _draw_legend(figure: Figure) -> None:
    """Beside the panels, where it hides no point; with what any of them shows."""
    found: dict[str, Any] = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        found |= dict(zip(labels, handles, strict=True))
    figure.legend(found.values(), found.keys(), loc="outside right upper", fontsize="small")


def _svg(figure: Figure) -> str:
    content = io.StringIO()
    figure.savefig(content, format="svg", metadata={"Date": None})
    plt.close(figure)
    text = content.getvalue()
    return text[text.index("<svg") :]
