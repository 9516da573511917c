"""How good the network's depth is on held-out examples, and whether its confidence is true."""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.reconstruction.depth_completion.network import CONFIDENT_WITHIN, DepthNetwork
from extrap_train.reconstruction.depth_completion.observation import CERTAIN, CHANNELS

BINS = 10
_FACTORS = 2.0 ** torch.arange(-2, 3.01, 0.25)
_ON_OBJECT = 4.0
"""Examples weigh more where the object is not certain (`examples.with_truth`)."""


@dataclass(frozen=True)
class DepthScores:
    """Over the object's pixels that no reference shows for certain."""

    median_error: float
    """Relative."""
    within: float
    """Share of the pixels within `CONFIDENT_WITHIN`."""
    said: float
    """Share of the pixels whose confidence is at least a half."""
    said_and_within: float
    """Share of those that are within `CONFIDENT_WITHIN`."""
    calibration_error: float
    """Mean absolute difference of confidence and share within, over bins of confidence."""


@dataclass(frozen=True)
class _Pixels:
    error: Float[Tensor, " n"]
    confidence: Float[Tensor, " n"]

    def scores(self) -> DepthScores:
        within = self.error <= CONFIDENT_WITHIN
        said = self.confidence >= 0.5
        return DepthScores(
            float(self.error.median()),
            float(within.float().mean()),
            float(said.float().mean()),
            float(within[said].float().mean()),
            self.calibration_error(within),
        )

    def calibration_error(self, within: Bool[Tensor, " n"]) -> float:
        place = (self.confidence * BINS).long().clamp(max=BINS - 1)
        count = torch.bincount(place, minlength=BINS)
        sums = [torch.bincount(place, x, minlength=BINS) for x in (self.confidence, within.float())]
        return float((sums[0] - sums[1]).abs().sum() / count.sum())


@torch.inference_mode()
def _pixels(network: DepthNetwork, batches: Iterable[Float[Tensor, "b c h w"]]) -> _Pixels:
    errors, confidences = [], []
    for batch in batches:
        log_depth, confidence = network(batch[:, :CHANNELS]).best()
        truth, weight = batch[:, CHANNELS], batch[:, CHANNELS + 1]
        chosen = (weight >= _ON_OBJECT) & (batch[:, CERTAIN] == 0)
        errors.append(((log_depth - truth).exp() - 1).abs()[chosen])
        confidences.append(confidence[chosen])
    return _Pixels(torch.cat(errors), torch.cat(confidences))


def score_depth(network: DepthNetwork, batches: Iterable[Float[Tensor, "b c h w"]]) -> DepthScores:
    """Scores over stored examples, as `network_training.StoredExamples.captures` gives them."""
    return _pixels(network, batches).scores()


def calibrate(network: DepthNetwork, batches: Iterable[Float[Tensor, "b c h w"]]) -> DepthScores:
    """Set the factor on all spreads that makes the confidence truest; returns the scores with it.

    `batches` must be of captures that the network was not trained on.
    """
    kept = list(batches)
    found = []
    for factor in _FACTORS.tolist():
        network.spread_factor.fill_(factor)
        found.append((score_depth(network, kept), factor))
    scores, factor = min(found, key=lambda pair: pair[0].calibration_error)
    network.spread_factor.fill_(factor)
    return scores
