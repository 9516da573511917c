"""Training of the depth network on examples that lie on disk, and how good it is on held-out ones:
whether its confidence is true.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.optim import AdamW

from extrap_train.config import TrainerConfig
from extrap_train.diffusion.averaging import AveragedModule
from extrap_train.diffusion.checkpoints import WholeCheckpointIO, find_damage
from extrap_train.diffusion.training import rate_at
from extrap_train.errors import InputError
from extrap_train.reconstruction.depth_prediction.depth_examples import DepthExamples
from extrap_train.reconstruction.depth_prediction.network import (
    CONFIDENT_WITHIN,
    WIDTHS,
    DepthMixture,
    DepthNetwork,
)
from extrap_train.reconstruction.depth_prediction.observation import CERTAIN, CHANNELS
from extrap_train.store.atomic import atomic_file, save_array

LEARNING_RATE = 1e-3
WEIGHT_DECAY = 0.01
MAX_GRADIENT = 1.0
_ENTRIES: dict[str, type] = {"step": int, "network": dict, "average": dict, "optimizer": dict}
"""What training cannot be resumed without."""
_TRUTH, _WEIGHT = CHANNELS, CHANNELS + 1


def save_examples(examples: DepthExamples, path: Path) -> None:
    """Write one capture's examples in half precision, ready to be mapped into memory."""
    maps = [examples.seen.features, examples.log_depth[:, None], examples.weight[:, None]]
    with atomic_file(path) as temporary:
        save_array(temporary, torch.cat(maps, 1).half().numpy())


@dataclass(frozen=True)
class StoredExamples:
    """The examples of several captures."""

    files: Sequence[Path]

    def batch(self, size: int, rng: np.random.Generator) -> Float[Tensor, "b c h w"]:
        """Random examples, half of them mirrored: features, true log depth, weight."""
        chosen = []
        for _ in range(size):
            capture = np.load(self.files[int(rng.integers(len(self.files)))], mmap_mode="r")
            example = np.asarray(capture[rng.integers(len(capture))], np.float32)
            if rng.random() < 0.5:
                example = np.ascontiguousarray(example[..., ::-1])
                example[CHANNELS - 2] *= -1  # the column
            chosen.append(torch.from_numpy(example))
        return torch.stack(chosen)

    def captures(self) -> Iterator[Float[Tensor, "b c h w"]]:
        """All examples, capture by capture."""
        for file in self.files:
            yield torch.from_numpy(np.load(file).astype(np.float32))


def loss_of(network: Callable[[Tensor], DepthMixture], batch: Float[Tensor, "b c h w"]) -> Tensor:
    """Weighted mean of the negative log-likelihood of the true log depth."""
    weight = batch[:, _WEIGHT]
    unlikely = network(batch[:, :CHANNELS]).negative_log_likelihood(batch[:, _TRUTH])
    return (weight * unlikely).sum() / weight.sum().clamp(min=1)


class DepthTraining:
    """A network, its running average and its optimiser; the same steps wherever it was resumed."""

    def __init__(self, options: TrainerConfig, seed: int, widths: tuple[int, ...] = WIDTHS) -> None:
        torch.manual_seed(seed)
        self.options, self.seed, self.step, self.widths = options, seed, 0, widths
        self.network = DepthNetwork(widths)
        self.average = AveragedModule(self.network, torch.device("cpu"), options.ema_decay)
        self.optimizer = AdamW(
            self.network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY
        )

    def advance(self, examples: StoredExamples) -> float:
        """Take one step; returns its loss."""
        for group in self.optimizer.param_groups:
            group["lr"] = LEARNING_RATE * rate_at(self.step, self.options)
        rng = np.random.default_rng((self.seed, self.step))
        loss = loss_of(self.network, examples.batch(self.options.batch_size, rng))
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), MAX_GRADIENT)
        self.optimizer.step()
        self.average.update_parameters(self.network)
        self.step += 1
        return float(loss.detach())

    def averaged_network(self) -> DepthNetwork:
        """A copy of the running average."""
        network = DepthNetwork(self.widths)
        network.load_state_dict(self.average.module.state_dict())
        return network.eval()

    def save(self, path: Path) -> None:
        """Write everything that `load` needs; InputError where the disk has no room for it."""
        state = {
            "step": self.step,
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }
        WholeCheckpointIO().save_checkpoint(state, path)

    def load(self, path: Path) -> None:
        """Go on from a checkpoint; InputError if it is damaged or of another network."""
        damage = find_damage(path, _ENTRIES)
        if damage is None:
            state = torch.load(path, weights_only=True)
            try:
                self.network.load_state_dict(state["network"])
                self.average.load_state_dict(state["average"])
                self.optimizer.load_state_dict(state["optimizer"])
            except (RuntimeError, ValueError, LookupError, TypeError) as error:
                damage = f"{type(error).__name__} {error}".splitlines()[0]
            else:
                self.step = state["step"]
        if damage is not None:
            raise InputError(
                f"{path}: cannot be resumed from ({damage}); delete it to train from the start"
            )


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
    """Share of the pixels with a confidence of at least .5."""
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
