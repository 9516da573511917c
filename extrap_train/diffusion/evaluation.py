"""Scores of a model, and of baselines without any training, on the same held-out examples."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import pandas as pd
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.config import SamplerConfig
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.sampler import sample_views
from extrap_train.metrics import Distance, psnr, quantised, ssim
from extrap_train.views import PairBatch, Warp, combine


@dataclass(frozen=True)
class Prediction:
    """Every method's image for one batch of held-out queries."""

    batch: PairBatch
    names: list[str]
    images: dict[str, Float[Tensor, "b 3 h w"]] = field(default_factory=dict)


def baseline_images(batch: PairBatch) -> dict[str, Float[Tensor, "b 3 h w"]]:
    """The nearest photograph, and the warp with its holes filled; the batch must hold its warp."""
    assert batch.warp is not None
    return {
        "nearest": batch.reference_images[:, 0],
        "inpainted": inpainted_warp(batch.warp),
        "mean_fill": mean_filled_warp(batch.warp),
    }


def predict(
    model: ExtrapolationModel,
    batch: PairBatch,
    names: list[str],
    sampler: SamplerConfig,
    seed: int,
) -> Prediction:
    """The model's sample and the baselines for a batch; one seed per view, by its name."""
    made = sample_views(model, batch, sampler, names, seed)
    return Prediction(batch, names, {"model": made, **baseline_images(batch)})


def score(prediction: Prediction, lpips: Distance | None) -> pd.DataFrame:
    """A row per view and method of a batch, see `score_images`."""
    batch = prediction.batch
    assert batch.warp is not None
    assert batch.object_mask is not None
    known, shown = batch.warp.mask, batch.object_mask.to(batch.image.dtype)
    return score_images(prediction.images, batch.image, known, shown, prediction.names, lpips)


def score_images(
    images: dict[str, Float[Tensor, "b 3 h w"]],
    truth: Float[Tensor, "b 3 h w"],
    known: Float[Tensor, "b h w"],
    shown: Float[Tensor, "b h w"],
    names: list[str],
    lpips: Distance | None,
) -> pd.DataFrame:
    """A row per view and method: PSNR in dB over five regions, ssim, lpips and lpips_object.

    Images and truth go through 8 bits first. `known` is 1 where a reference reaches; `psnr_holes`
    is over the other pixels, `psnr_warped` over these. `shown` is 1 where the truth shows the
    object; `psnr_object` is over these pixels, `psnr_object_holes` over those of them that no
    reference reaches. `lpips_object` compares the object on black, as CO3D's benchmark does. A
    score is NaN where a view has no such pixel, or where LPIPS cannot be had.
    """
    truth = quantised(truth)

    object_only = shown[:, None]
    has_object = shown.flatten(1).any(1).cpu()
    unknown = torch.full((len(truth),), torch.nan)
    tables = []
    for method, image in images.items():
        made = quantised(image)
        columns = {
            "psnr": psnr(made, truth),
            "psnr_holes": psnr(made, truth, 1 - known),
            "psnr_warped": psnr(made, truth, known),
            "psnr_object": psnr(made, truth, shown),
            "psnr_object_holes": psnr(made, truth, shown * (1 - known)),
            "ssim": ssim(made, truth),
            "lpips": unknown,
            "lpips_object": unknown,
        }
        if lpips is not None:
            cut_out = lpips(made * object_only, truth * object_only).cpu()
            columns["lpips"] = lpips(made, truth)
            columns["lpips_object"] = torch.where(has_object, cut_out, unknown)
        table = pd.DataFrame(
            {name: values.cpu().double().numpy() for name, values in columns.items()}
        )
        tables.append(table.assign(method=method, view=names))
    return pd.concat(tables, ignore_index=True)


def missing_scores(reasons: Mapping[str, str]) -> dict[str, str]:
    """Why scores are missing, by their names, from why LPIPS cannot be had."""
    return {**reasons, **({"lpips_object": reasons["lpips"]} if "lpips" in reasons else {})}


def summarise(scores: pd.DataFrame) -> dict[str, dict[str, float]]:
    """Mean of every metric by method over the views that have it."""
    means = scores.drop(columns="view").groupby("method", sort=False).mean()
    return {str(m): {str(k): float(v) for k, v in row.items()} for m, row in means.iterrows()}


def better_than_baselines(summary: dict[str, dict[str, float]]) -> float:
    """How many dB of PSNR the model is above the best baseline."""
    others = [row["psnr"] for method, row in summary.items() if method != "model"]
    return summary["model"]["psnr"] - max(others)


def views_named(predictions: list[Prediction], names: list[str]) -> Prediction:
    """Those of the views that are there, in this order and once each, as one on the CPU."""
    there = [name for p in predictions for name in p.names]
    found = [name for name in names if name in there]
    chosen = torch.tensor([there.index(name) for name in found], dtype=torch.long)

    def taken(tensors: Sequence[Tensor]) -> Tensor:
        whole = torch.cat(list(tensors))
        return whole[chosen.to(whole.device)].cpu()

    return Prediction(
        combine([p.batch for p in predictions], taken),
        found,
        {m: taken([p.images[m] for p in predictions]) for m in predictions[0].images},
    )


_TELEA_RADIUS = 3.0


def inpainted_warp(warp: Warp) -> Float[Tensor, "b 3 h w"]:
    """The warp with its holes inpainted (Telea 2004)."""
    return torch.stack([_telea(i, m) for i, m in zip(warp.image, warp.mask, strict=True)])


def mean_filled_warp(warp: Warp) -> Float[Tensor, "b 3 h w"]:
    """The warp with its holes in the mean colour of what is known; mid-grey where nothing is."""
    known = warp.mask[:, None]
    count = known.sum((-2, -1), keepdim=True)
    mean = (warp.image * known).sum((-2, -1), keepdim=True) / count.clamp_min(1)
    return torch.where(known > 0, warp.image, torch.where(count > 0, mean, 0.5))


def _telea(image: Float[Tensor, "3 h w"], mask: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    pixels = (image * 255).round().byte().permute(1, 2, 0).cpu().numpy()
    holes = (mask == 0).byte().cpu().numpy()
    if holes.all():
        return torch.full_like(image, 0.5)
    painted = cv2.inpaint(np.ascontiguousarray(pixels), holes, _TELEA_RADIUS, cv2.INPAINT_TELEA)
    filled = torch.from_numpy(painted).permute(2, 0, 1).to(image) / 255
    return torch.where(mask > 0, image, filled)
