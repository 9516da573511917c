"""What was prepared, to look at: printed, and saved as a page with pictures."""

from importlib.resources import files
from pathlib import Path

import numpy as np
import pandas as pd
from jinja2 import Environment, Template
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from data_prep.reasons import kinds_of
from data_prep.report_pairs import (
    as_png,
    correction_report,
    pair_sheet,
    share_corrected,
)
from data_prep.split import held_out
from extrap_train.data.prepared import Pairs, PreparedData
from extrap_train.geometry.viewpoints import fit_orbit
from extrap_train.store.atomic import write_atomic

SAMPLES = 8
"""Pairs on the picture sheet, from the easiest to the hardest."""
_LISTED = 200
"""Dropped sequences that the page names one by one."""
_REASONS = 20
_COLOURS = {"train": "tab:blue", "test": "tab:orange"}


def write_report(data: PreparedData, console: Console) -> Path:
    """Print a summary of prepared data, save `report/` in its folder, and return the page."""
    folder = data.folder / "report"
    facts = summary(data)
    dropped = data.sequences[~data.sequences["kept"]]
    reasons = _reasons(dropped)
    _print(facts, reasons, console)
    write_atomic(folder / "histograms.png", as_png(histograms(data)))
    write_atomic(folder / "coverage.png", as_png(coverage(data)))
    pairs = data.pairs("train")
    pair_sheet(data, _from_easy_to_hard(pairs, SAMPLES), folder / "pairs.png")
    listed = list(dropped[["sequence", "reason"]].head(_LISTED).itertuples(index=False, name=None))
    page = folder / "report.html"
    content = _page().render(
        title=f"Prepared data: {', '.join(_categories(data))}",
        facts=facts,
        reasons=reasons,
        dropped=listed,
        unlisted=len(dropped) - len(listed),
        **correction_report(data, folder),
    )
    write_atomic(page, content.encode())
    console.print(f"report: {page}")
    return page


def _page() -> Template:
    """The page's template; everything that it is filled with is escaped."""
    source = files("data_prep").joinpath("templates/report.html").read_text("utf-8")
    return Environment(autoescape=True, trim_blocks=True).from_string(source)


def _categories(data: PreparedData) -> list[str]:
    return sorted({name.split("/", 1)[0] for name in data.sequences["sequence"]})


def _reasons(dropped: pd.DataFrame) -> list[tuple[str, int]]:
    """What sequences were left out for, the most frequent first."""
    rows = zip(dropped["sequence"], dropped["reason"], strict=True)
    plain = (reason.removeprefix(f"sequence {name}: ") for name, reason in rows)
    return [(kind.short, kind.count) for kind in kinds_of(plain)[:_REASONS]]


def summary(data: PreparedData) -> dict[str, str]:
    """The report's facts, by what they are."""
    sequences = data.sequences
    kept = sequences[sequences["kept"]]
    facts = {
        "sequences kept": f"{len(kept)} of {len(sequences)}",
        "trained on / tested on": " / ".join(
            str(kept["split"].str.contains(split).sum()) for split in ("train", "test")
        ),
        "frames": f"{kept['frames'].sum()} of {data.image_size}² pixels",
    }
    for split in ("train", "test"):
        pairs = data.pairs(split)
        facts[f"{split} pairs"] = str(len(pairs))
        if len(pairs):
            low, middle, high = np.degrees(np.quantile(pairs.angle_rad, (0.05, 0.5, 0.95)))
            facts[f"{split} angles"] = (
                f"median {middle:.0f}°, 5 % and 95 % quantiles {low:.0f}° and {high:.0f}°"
            )
    if data.is_corrected:
        facts["warps corrected"] = share_corrected(data)
    facts["split"] = f"sha256 {data.manifest['split'][:16]}…"
    return facts


def histograms(data: PreparedData) -> Figure:
    """Angles and scores of the pairs, by split."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    angle_axes, score_axes = figure.subplots(1, 2)
    for split, colour in _COLOURS.items():
        pairs = data.pairs(split)
        if not len(pairs):
            continue
        style = {"color": colour, "alpha": 0.6, "density": True, "label": split}
        angle_axes.hist(np.degrees(pairs.angle_rad), np.arange(0, 91, 5), **style)
        score_axes.hist(pairs.score, np.linspace(0, 0.25, 26), **style)
    angle_axes.set(xlabel="angle between reference and query (degrees)", ylabel="density of pairs")
    score_axes.set(xlabel=r"score $\cos\alpha\,(1 - \cos\alpha)$")
    angle_axes.legend()
    return figure


def coverage(data: PreparedData) -> Figure:
    """Azimuths of the cameras around their orbits: a ring for each of at most 24 sequences."""
    kept = data.sequences[data.sequences["kept"]]
    shown = kept.iloc[_evenly(len(kept), 24)]
    figure = Figure(figsize=(5, 5), layout="constrained")
    axes = figure.add_subplot(projection="polar")
    for ring, (name, role) in enumerate(zip(shown["sequence"], shown["split"], strict=True)):
        azimuths = fit_orbit(data.cameras(name)).azimuths_rad
        tested = held_out(len(azimuths)) if role == "train and test" else role == "test"
        tested = np.broadcast_to(tested, azimuths.shape)
        for split, own in (("train", ~tested), ("test", tested)):
            rings, colour = np.full(own.sum(), ring + 8), _COLOURS[split]
            axes.plot(azimuths[own], rings, ".", color=colour, markersize=4)
    axes.set(yticks=[], ylim=(0, len(shown) + 8))
    axes.set_title("azimuths of the frames, a ring a sequence (orange: test)")
    return figure


def _evenly(available: int, wanted: int) -> list[int]:
    """At most `wanted` indices, evenly over those there are."""
    return (
        np.unique(np.linspace(0, available - 1, min(wanted, available)).round())
        .astype(int)
        .tolist()
    )


def _from_easy_to_hard(pairs: Pairs, count: int) -> list[int]:
    order = np.argsort(pairs.angle_rad, kind="stable")
    return [int(order[place]) for place in _evenly(len(pairs), count)]


def _print(facts: dict[str, str], reasons: list[tuple[str, int]], console: Console) -> None:
    table = Table(title="prepared data", show_header=False)
    for what, value in facts.items():
        table.add_row(what, value)
    for reason, count in reasons[:5]:
        table.add_row(f"left out: {count}", reason)
    console.print(table, markup=False)
