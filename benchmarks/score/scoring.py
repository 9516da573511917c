"""All numbers of one cell, from saved images: 8 bits on both sides, colours in [0, 1].

A metric without a value says why; no other network's number stands in for it.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from benchmarks.protocol.array_files import array_of, pictures_of
from benchmarks.protocol.prepared_scene import Scene, Truth
from benchmarks.score import Score
from benchmarks.score.view_consistency import tsed, warp_psnr
from extrap_train.config import MetricConfig, ScoringConfig
from extrap_train.errors import InputError
from extrap_train.factories import make_object
from extrap_train.metrics import (
    Distance,
    dists_distance,
    lpips_distance,
    psnr,
    require_unit_range,
    ssim,
)
from extrap_train.reconstruction.cloud_metrics import TOLERANCE, score_cloud

_NO_POINTS = "the method gives no geometry"
_NO_SURFACE = "the capture's true surface is not known"
_NO_DEPTH = "the capture has no true depth"
_ALL_SEEN = "the inputs reach every pixel of every target"
_NONE_SEEN = "the inputs reach no pixel of any target"


def score_images(
    images: Float[Tensor, "n 3 h w"], truth: Truth, config: ScoringConfig
) -> dict[str, Score]:
    """Every metric of the images of one cell, by column name."""
    for pictures in (images, truth.images):
        require_unit_range(pictures)
    seen, unseen = truth.masks, 1 - truth.masks
    single: dict[str, tuple[Float[Tensor, " n"], str]] = {
        "psnr": (psnr(images, truth.images), ""),
        "ssim": (ssim(images, truth.images), ""),
        "masked_psnr": (psnr(images, truth.images, seen), _NONE_SEEN),
        "masked_ssim": (ssim(images, truth.images, seen), _NONE_SEEN),
        "unseen_psnr": (psnr(images, truth.images, unseen), _ALL_SEEN),
        "unseen_ssim": (ssim(images, truth.images, unseen), _ALL_SEEN),
        "coverage": (seen.mean((1, 2)), ""),
    }
    scores = {name: _of_images(values, reason) for name, (values, reason) in single.items()}
    return (
        _perceptual(images, truth.images, config)
        | scores
        | megascenes_compat(images, truth)
        | _consistency(images, truth)
        | {name: _own(name, metric, images, truth) for name, metric in config.own.items()}
    )


@runtime_checkable
class Metric(Protocol):
    """A metric of your own: a class whose fields are its options."""

    def score(self, images: Float[Tensor, "n 3 h w"], truth: Truth) -> Float[Tensor, " n"]:
        """One number per image, colours in [0, 1]; NaN where it has no meaning."""
        ...


def _own(name: str, config: MetricConfig, images: Tensor, truth: Truth) -> Score:
    prefix = f"metric {name}: "
    metric: Metric = make_object(config.factory, config.options, f"metric {name}", Metric, prefix)
    values = metric.score(images, truth)
    if not isinstance(values, Tensor) or values.shape != (len(images),):
        raise InputError(f"{prefix}{config.factory} must return one number per image, a tensor (n)")
    return _of_images(values, "it gives no number for any image")


def score_files(
    folder: Path,
    images: Mapping[str, bytes],
    points: Mapping[str, bytes],
    scene: Scene,
    scoring: ScoringConfig,
) -> dict[str, Score]:
    """Every metric of a cell from its files, which lie in `folder`."""
    names = [f"{index}.png" for index in range(len(scene.draw.targets))]
    if list(images) != names or not points.keys() <= {"points.npy"}:
        raise InputError(f"{folder}: holds other files than {names[0]} … {names[-1]}")
    side = scene.record.image_size
    pictures = pictures_of({folder / name: data for name, data in images.items()}, side)
    clouds = [array_of(content, (None, 3), folder / name) for name, content in points.items()]
    truth = scene.truth()
    scores = score_images(pictures, truth, scoring)
    return scores | score_points(clouds[0] if clouds else None, truth)


def score_points(points: Float[Tensor, "m 3"] | None, truth: Truth) -> dict[str, Score]:
    """How well a method's points lie on the object, and how much of it they show (in its box).

    Shares within 2 % of the object's largest side; `accuracy_distance` is the points' mean distance
    to the true surface as a share of that side.
    """
    names = ("accuracy_share", "completeness", "f_score", "accuracy_distance")
    if points is None or truth.surface is None:
        reason = _NO_POINTS if points is None else _NO_SURFACE
        return {name: Score(None, reason) for name in names}
    target = truth.surface.object.double().numpy()
    size = float((target.max(0) - target.min(0)).max())
    around = truth.surface.surroundings.double().numpy()
    found = score_cloud(points.double().numpy(), target, around, TOLERANCE * size)
    values = (found.accuracy, found.completeness, found.f_score, found.mean_to_truth / size)
    return {
        name: Score(value) if math.isfinite(value) else Score(None, "no point is near the object")
        for name, value in zip(names, values, strict=True)
    }


def _of_images(values: Float[Tensor, " n"], reason: str) -> Score:
    """Mean over the images that have the metric; InputError for NaN without a reason for one."""
    if not reason and not values.isfinite().all():
        raise InputError("gives numbers that are not finite; its weights may be damaged")
    known = [None if math.isnan(v) else v for v in values.double().tolist()]
    present = [v for v in known if v is not None]
    if not present:
        return Score(None, reason)
    return Score(sum(present) / len(present), per_image=known)


def _perceptual(
    images: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"], config: ScoringConfig
) -> dict[str, Score]:
    scores = {}
    for column in config.judged:
        try:
            scores[column] = _of_images(_network(column, config)(images, truth), "")
        except InputError as error:
            scores[column] = Score(None, str(error))
    return scores


def missing_networks(config: ScoringConfig) -> dict[str, str]:
    """The perceptual metrics that cannot be had here, each with its reason."""
    reasons = {}
    for column in config.judged:
        try:
            _network(column, config)
        except InputError as error:
            reasons[column] = str(error)
    return reasons


def _network(column: str, config: ScoringConfig) -> Distance:
    net = column.removeprefix("lpips_")
    return _dists() if column == "dists" else _lpips(net, config.lpips_weights.get(net))


@lru_cache(3)
def _lpips(net: str, weights: str | None) -> Distance:
    return lpips_distance(net, weights, f"scoring.lpips_weights.{net}")


@lru_cache(1)
def _dists() -> Distance:
    return dists_distance()


def megascenes_compat(images: Float[Tensor, "n 3 h w"], truth: Truth) -> dict[str, Score]:
    """Masked PSNR and SSIM as MegaScenes' published code computes them, for comparison with its
    numbers only.

    Images in [-1, 1] are multiplied by the warped *colours* in [0, 1], which serve as a mask; the
    error is over all pixels, not those of the mask, and pooled over the images before the
    logarithm. Scores are higher the less a warp covers.
    """
    # It loads transformers, for which a dry run need not wait.
    from torchmetrics.functional.image import structural_similarity_index_measure

    made, true = ((2 * pictures - 1) * truth.warps for pictures in (images, truth.images))
    error = float((made - true).square().mean())
    similarity = structural_similarity_index_measure(made, true, data_range=2.0)
    assert isinstance(similarity, Tensor)
    return {
        "compat_psnr": Score(10 * math.log10(4 / max(error, 1e-10))),
        "compat_ssim": Score(float(similarity)),
    }


def _consistency(images: Float[Tensor, "n 3 h w"], truth: Truth) -> dict[str, Score]:
    too_few = "there is a single target"
    scores = {"tsed": _or_reason(tsed(images, truth.cameras), too_few)}
    scores["tsed_truth"] = _or_reason(tsed(truth.images, truth.cameras), too_few)
    pairs: Mapping[str, Tensor] = {"warp_psnr": images, "warp_psnr_truth": truth.images}
    for name, pictures in pairs.items():
        if truth.depths is None:
            scores[name] = Score(None, _NO_DEPTH)
        else:
            value = warp_psnr(pictures, truth.depths, truth.cameras)
            scores[name] = _or_reason(value, "no two neighbouring targets see enough in common")
    return scores


def _or_reason(value: float, reason: str) -> Score:
    return Score(None, reason) if math.isnan(value) else Score(value)
