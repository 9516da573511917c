"""What was prepared, to look at: printed, and saved as a page with pictures."""

import io
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from extrap_train.data.files import write_whole
from extrap_train.data.store import Pairs, PreparedData
from extrap_train.geometry.viewpoints import fit_orbit
from extrap_train.geometry.warp import warp_references
from extrap_train.pictures import colour_depth, contact_sheet, mark_holes
from extrap_train.views import ViewPair, stack_cameras

SAMPLES = 8
"""Pairs on the picture sheet, from the easiest to the hardest."""
_LISTED = 40
"""Dropped sequences that the page names one by one."""
_COLOURS = {"train": "tab:blue", "test": "tab:orange"}


def write_report(data: PreparedData, console: Console) -> Path:
    """Print a summary of prepared data, save `report/` in its folder, and return the page."""
    folder = data.folder / "report"
    facts = summary(data)
    dropped = data.sequences[~data.sequences["kept"]]
    _print(facts, dropped, console)
    write_whole(folder / "histograms.png", _png(histograms(data)))
    write_whole(folder / "coverage.png", _png(coverage(data)))
    picture_sheet(data, folder / "pairs.png")
    page = folder / "report.md"
    write_whole(page, _markdown(facts, dropped).encode())
    return page


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
            facts[f"{split} angles"] = f"{low:.0f}° to {high:.0f}°, median {middle:.0f}°"
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
    for ring, (name, split) in enumerate(zip(shown["sequence"], shown["split"], strict=True)):
        azimuths = fit_orbit(data.cameras(name)).azimuths_rad
        colour = _COLOURS["test" if split == "test" else "train"]
        axes.plot(azimuths, np.full(len(azimuths), ring + 8), ".", color=colour, markersize=4)
    axes.set(yticks=[], ylim=(0, len(shown) + 8))
    axes.set_title(f"azimuths of {len(shown)} sequences (orange: test)")
    return figure


def picture_sheet(data: PreparedData, path: Path) -> None:
    """Training pairs from the smallest to the largest angle: reference, depth, warp, query."""
    pairs = data.pairs("train")
    chosen = _from_easy_to_hard(pairs, SAMPLES)
    views = [data.frames(p.sequence, [p.references[0], p.query]) for p in chosen]
    images = torch.stack([images for images, _, _ in views])
    depths = torch.stack([depths for _, depths, _ in views])
    cameras = stack_cameras(
        [data.cameras(p.sequence)[torch.tensor([p.references[0], p.query])] for p in chosen]
    )
    warp = warp_references(
        images[:, :1],
        depths[:, :1],
        cameras[:, :1],
        torch.ones(len(chosen), 1, dtype=torch.bool),
        cameras[:, 1],
    )
    columns = {
        "reference": images[:, 0],
        "its depth": colour_depth(depths[:, 0]),
        "warp (holes magenta)": mark_holes(warp.image, warp.mask),
        "query": images[:, 1],
    }
    contact_sheet(columns, path)


def _evenly(available: int, wanted: int) -> list[int]:
    """At most `wanted` indices, evenly over those there are."""
    return (
        np.unique(np.linspace(0, available - 1, min(wanted, available)).round())
        .astype(int)
        .tolist()
    )


def _from_easy_to_hard(pairs: Pairs, count: int) -> list[ViewPair]:
    order = np.argsort(pairs.angle_rad, kind="stable")
    return [pairs[int(order[place])] for place in _evenly(len(pairs), count)]


def _print(facts: dict[str, str], dropped: pd.DataFrame, console: Console) -> None:
    table = Table(title="prepared data", show_header=False)
    for what, value in facts.items():
        table.add_row(what, value)
    for reason, count in dropped["reason"].value_counts().head(5).items():
        table.add_row(f"dropped: {count}", str(reason))
    console.print(table, markup=False)


def _markdown(facts: dict[str, str], dropped: pd.DataFrame) -> str:
    lines = ["# Prepared data", "", "| | |", "|---|---|"]
    lines += [f"| {what} | {value} |" for what, value in facts.items()]
    lines += ["", "![pairs](pairs.png)", "", "![histograms](histograms.png)", ""]
    lines += ["![coverage](coverage.png)", "", f"## Dropped sequences: {len(dropped)}", ""]
    if len(dropped):
        lines += ["| sequence | reason |", "|---|---|"]
    for name, reason in dropped[["sequence", "reason"]].head(_LISTED).itertuples(index=False):
        lines.append(f"| {_cell(name)} | {_cell(reason)} |")
    if len(dropped) > _LISTED:
        lines += ["", f"… and {len(dropped) - _LISTED} more in `sequences.parquet`."]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    """Untrusted text for a table's cell."""
    return " ".join(text.split()).replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;")


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=100)
    return content.getvalue()
