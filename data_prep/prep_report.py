"""Report of prepared data: a printed summary and a page with pictures."""

import io
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from jinja2 import Environment
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from data_prep.filter import group_reasons
from extrap_train.data.examples import linspace_indices, pack, read_example
from extrap_train.data.prepared import UNTOUCHED, Pairs, PreparedData
from extrap_train.data.square_frames import held_out_mask
from extrap_train.figures import colour_depth, draw_contact_sheet, error_map, mark_holes
from extrap_train.geometry.viewpoints import camera_centers, fit_orbit
from extrap_train.geometry.warp import warp_references
from extrap_train.store.atomic import write_atomic

WORST = 20
"""Pairs that the page shows for being furthest from the truth."""
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
    by_angle = np.argsort(data.pairs("train").angle_rad, kind="stable")
    chosen = by_angle[linspace_indices(len(by_angle), SAMPLES)].tolist()
    draw_pair_sheet(data, chosen, folder / "pairs.png")
    listed = list(dropped[["sequence", "reason"]].head(_LISTED).itertuples(index=False, name=None))
    page = folder / "report.html"
    source = files("data_prep").joinpath("templates/report.html").read_text("utf-8")
    template = Environment(autoescape=True, trim_blocks=True).from_string(source)
    categories = sorted(set(data.sequences["sequence"].str.partition("/")[0]))
    content = template.render(
        title=f"Prepared data: {', '.join(categories)}",
        facts=facts,
        reasons=reasons,
        dropped=listed,
        unlisted=len(dropped) - len(listed),
        **report_correction(data, folder),
    )
    write_atomic(page, content.encode())
    console.print(f"report: {page}")
    return page


def _reasons(dropped: pd.DataFrame) -> list[tuple[str, int]]:
    """What sequences were left out for, the most frequent first."""
    rows = zip(dropped["sequence"], dropped["reason"], strict=True)
    plain = (reason.removeprefix(f"sequence {name}: ") for name, reason in rows)
    return [(kind.short, kind.count) for kind in group_reasons(plain)[:_REASONS]]


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
    shown = kept.iloc[linspace_indices(len(kept), 24)]
    figure = Figure(figsize=(5, 5), layout="constrained")
    axes = figure.add_subplot(projection="polar")
    for ring, (name, role) in enumerate(zip(shown["sequence"], shown["split"], strict=True)):
        cameras = data.cameras(name)
        azimuths, _, _ = fit_orbit(cameras).locate(camera_centers(cameras))
        tested = held_out_mask(len(azimuths)) if role == "train and test" else role == "test"
        tested = np.broadcast_to(tested, azimuths.shape)
        for split, own in (("train", ~tested), ("test", tested)):
            rings, colour = np.full(own.sum(), ring + 8), _COLOURS[split]
            axes.plot(azimuths[own], rings, ".", color=colour, markersize=4)
    axes.set(yticks=[], ylim=(0, len(shown) + 8))
    axes.set_title("azimuths of the frames, a ring a sequence (orange: test)")
    return figure


def report_correction(data: PreparedData, folder: Path) -> dict[str, Any]:
    """What the page says of correction; draws its pictures into `folder`."""
    if not data.is_corrected:
        return {"corrections": {}, "worst": []}
    pairs = data.pairs("train")
    order = np.argsort(-np.nan_to_num(pairs.error_after, nan=-1.0), kind="stable")
    worst = [int(index) for index in order[:WORST]]
    write_atomic(folder / "correction.png", as_png(error_histogram(pairs)))
    draw_pair_sheet(data, worst, folder / "worst.png")
    return {"corrections": correction_facts(data), "worst": [_row(data, pairs, i) for i in worst]}


def share_corrected(data: PreparedData) -> str:
    """How many training warps are moved."""
    moved = data.pairs("train").flow != UNTOUCHED
    return f"{int(moved.sum())} of {len(moved)}"


def correction_facts(data: PreparedData) -> dict[str, str]:
    """Gain and reasons, by what they are."""
    pairs = data.pairs("train")
    moved = pairs.flow != UNTOUCHED
    facts = {"matcher": str(data.manifest["correction"]), "warps moved": share_corrected(data)}
    if moved.any():
        gain = 1 - pairs.error_after[moved] / pairs.error_before[moved]
        low, middle, high = np.quantile(gain, (0.05, 0.5, 0.95))
        facts["photometric error taken away"] = (
            f"median {middle:.1%}, 5 % and 95 % quantiles {low:.1%} and {high:.1%}"
        )
    for group in group_reasons(pairs.uncorrected[~moved])[:6]:
        facts[f"left alone because {group.short}"] = str(group.count)
    return facts


def error_histogram(pairs: Pairs) -> Figure:
    """Photometric errors of the training warps, before and after; what does not fit is counted."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    axes = figure.subplots()
    known = np.isfinite(pairs.error_before)
    top = float(np.quantile(pairs.error_before[known], 0.99)) if known.any() else 1.0
    bins = np.linspace(0, max(top, 1e-6), 41)
    for name, errors in (("before", pairs.error_before), ("after", pairs.error_after)):
        beyond = int((errors[known] > bins[-1]).sum())
        label = f"{name} ({beyond} beyond {bins[-1]:.3g})" if beyond else name
        axes.hist(errors[known], bins.tolist(), alpha=0.6, label=label)
    axes.set(xlabel="mean colour difference between warp and truth", ylabel="pairs")
    axes.legend()
    return figure


def draw_pair_sheet(data: PreparedData, chosen: list[int], path: Path) -> None:
    """Training pairs, one per row: reference, depth, warp without and with flow, query, error.

    The caption of a row gives its number, angle, sequence, reference and query.
    """
    pairs = data.pairs("train")
    examples = [read_example(data, pairs[index], data.is_corrected) for index in chosen]
    batch = pack(examples, references=1).unpack()
    plain, moved = (
        warp_references(
            batch.reference_images,
            batch.reference_depths,
            batch.reference_cameras,
            batch.reference_valid,
            batch.camera,
            flows,
        )
        for flows in (None, batch.reference_flows)
    )
    columns = {
        "reference": batch.reference_images[:, 0],
        "its depth": colour_depth(batch.reference_depths[:, 0]),
        "warp (holes magenta)": mark_holes(plain.image, plain.mask),
    }
    if data.is_corrected:
        columns["warp as trained on"] = mark_holes(moved.image, moved.mask)
    columns["query"] = batch.image
    shown = torch.where(moved.mask[:, None] > 0, moved.image, batch.image)
    columns["error of the warp"] = error_map(shown, batch.image)
    rows = [_row(data, pairs, index) for index in chosen]
    captions = [
        f"{number}: {row['angle']}, {row['sequence']}, {row['reference']} → {row['query']}"
        for number, row in enumerate(rows, start=1)
    ]
    draw_contact_sheet(columns, path, captions)


def _row(data: PreparedData, pairs: Pairs, index: int) -> dict[str, Any]:
    names = data.names(pairs.sequence[index])
    return {
        "sequence": pairs.sequence[index],
        "reference": names[int(pairs.reference[index])],
        "query": names[int(pairs.query[index])],
        "angle": f"{np.degrees(pairs.angle_rad[index]):.0f}°",
        "before": f"{pairs.error_before[index]:.4f}",
        "after": f"{pairs.error_after[index]:.4f}",
        "reason": pairs.uncorrected[index],
    }


def _print(facts: dict[str, str], reasons: list[tuple[str, int]], console: Console) -> None:
    table = Table(title="prepared data", show_header=False)
    for what, value in facts.items():
        table.add_row(what, value)
    for reason, count in reasons[:5]:
        table.add_row(f"left out: {count}", reason)
    console.print(table, markup=False)


def as_png(figure: Figure) -> bytes:
    """The figure as a file's content."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=100)
    return content.getvalue()
