"""The report's pictures of pairs, and what correction did for them."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from data_prep.reasons import kinds_of
from extrap_train.data.prepared import UNTOUCHED, Pairs, PreparedData
from extrap_train.geometry.warp import warp_references
from extrap_train.pictures import colour_depth, contact_sheet, error_map, mark_holes
from extrap_train.store.atomic import write_atomic
from extrap_train.views import PairBatch, stack_cameras

WORST = 20
"""Pairs that the page shows for being furthest from the truth."""


def correction_report(data: PreparedData, folder: Path) -> dict[str, Any]:
    """What the page says of correction; draws its pictures into `folder`."""
    if not data.is_corrected:
        return {"corrections": {}, "worst": []}
    pairs = data.pairs("train")
    order = np.argsort(-np.nan_to_num(pairs.error_after, nan=-1.0), kind="stable")
    worst = [int(index) for index in order[:WORST]]
    write_atomic(folder / "correction.png", as_png(error_histogram(pairs)))
    pair_sheet(data, worst, folder / "worst.png")
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
    for kind in kinds_of(pairs.uncorrected[~moved])[:6]:
        facts[f"left alone because {kind.short}"] = str(kind.count)
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


def pair_sheet(data: PreparedData, chosen: list[int], path: Path) -> None:
    """Training pairs, a row each: reference, depth, warp without and with flow, query, error.

    Above each row stand its number, angle, sequence, reference and query.
    """
    pairs = data.pairs("train")
    batch = _batch(data, pairs, chosen)
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
    contact_sheet(columns, path, captions)


def _batch(data: PreparedData, training: Pairs, chosen: list[int]) -> PairBatch:
    pairs = [training[index] for index in chosen]
    views = [data.frames(p.sequence, [p.references[0], p.query]) for p in pairs]
    images = torch.stack([images for images, _, _ in views])
    depths = torch.stack([depths for _, depths, _ in views])
    cameras = stack_cameras(
        [data.cameras(p.sequence)[torch.tensor([p.references[0], p.query])] for p in pairs]
    )
    flows = [data.flows(p.sequence, p.references, p.query) for p in pairs]
    return PairBatch(
        image=images[:, 1],
        camera=cameras[:, 1],
        reference_images=images[:, :1],
        reference_cameras=cameras[:, :1],
        reference_depths=depths[:, :1],
        reference_valid=torch.ones(len(pairs), 1, dtype=torch.bool),
        reference_flows=torch.stack(flows) if data.is_corrected else None,
    )


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


def as_png(figure: Figure) -> bytes:
    """The figure as a file's content."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=100)
    return content.getvalue()
