"""How good the network's depth is on held-out examples, and whether its confidence is true."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.reconstruction.depth_prediction.network import (
    CONFIDENT_WITHIN,
    DepthMixture,
    DepthNetwork,
)
from extrap_train.reconstruction.depth_prediction.observation import CERTAIN, CHANNELS

BINS = 10
_FACTORS = 2.0 ** torch.arange(-2, 3.01, 0.25)
_ON_OBJECT = 4.0
"""Examples weigh more where the object is not certain (`depth_examples.with_truth`)."""


@dataclass(frozen=True)
class DepthScores:
    """Depth errors over the object's pixels that no reference shows for certain."""

    median_error: float
    """Median relative error of depth."""
    within: float
    """Share of the pixels within `CONFIDENT_WITHIN`."""
    confident: float
    """Share of the pixels whose confidence is .5 or more."""
    confident_and_within: float
    """Share of the confident pixels within `CONFIDENT_WITHIN`."""
    calibration_error: float
    """Mean absolute difference of confidence and share within, over bins of confidence."""


@torch.inference_mode()
def calibrate(network: DepthNetwork, batches: Iterable[Float[Tensor, "b c h w"]]) -> DepthScores:
    """Set the factor on all spreads that calibrates the confidence best; return the scores.

    `batches` are stored examples, as `network_training.StoredExamples.captures` gives them, of
    captures that the network was not trained on.
    """
    network.spread_factor.fill_(1)
    mixture, truth = _pixels(network, batches)
    found = []
    for factor in _FACTORS.tolist():
        scaled = replace(mixture, spreads=mixture.spreads * factor)
        found.append((_score(scaled, truth), factor))
    scores, factor = min(found, key=lambda pair: pair[0].calibration_error)
    network.spread_factor.fill_(factor)
    return scores


def _pixels(
    network: DepthNetwork, batches: Iterable[Float[Tensor, "b c h w"]]
) -> tuple[DepthMixture, Float[Tensor, "1 1 n"]]:
    """The network's answer and the true log depth, pixels in a row."""
    answers, truths = [], []
    for batch in batches:
        chosen = (batch[:, CHANNELS + 1] >= _ON_OBJECT) & (batch[:, CERTAIN] == 0)
        found = network(batch[:, :CHANNELS])
        maps = torch.stack([found.modes, found.spreads, found.log_shares])
        answers.append(maps.movedim(2, -1)[:, chosen])
        truths.append(batch[:, CHANNELS][chosen])
    modes, spreads, log_shares = torch.cat(answers, 1).mT[:, None, :, None]
    return DepthMixture(modes, spreads, log_shares), torch.cat(truths)[None, None]


def _score(mixture: DepthMixture, truth: Float[Tensor, "1 1 n"]) -> DepthScores:
    log_depth, confidence = mixture.best()
    error = ((log_depth - truth).exp() - 1).abs().flatten()
    confidence = confidence.flatten()
    within, is_confident = error <= CONFIDENT_WITHIN, confidence >= 0.5
    return DepthScores(
        float(error.median()),
        float(within.float().mean()),
        float(is_confident.float().mean()),
        float(within[is_confident].float().mean()),
        _calibration_error(confidence, within),
    )


def _calibration_error(confidence: Float[Tensor, " n"], within: Bool[Tensor, " n"]) -> float:
    place = (confidence * BINS).long().clamp(max=BINS - 1)
    sums = [torch.bincount(place, x, minlength=BINS) for x in (confidence, within.float())]
    return float((sums[0] - sums[1]).abs().sum() / len(confidence))
