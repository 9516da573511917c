"""Depth sources and matchers of jobs: their options are sent, every process builds them once.

A network that is sent to another process takes a file descriptor for each tensor, and a waiting job
keeps them open: a few jobs with MASt3R's nine hundred tensors exceed a process's limit.
"""

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import torch

from extrap_train.config import DepthConfig, MatcherConfig
from extrap_train.data.paths import file_stamp
from extrap_train.depth import DepthSource
from extrap_train.depth.sources import depth_source, weight_files
from extrap_train.device import fastest_device
from extrap_train.jobs import available_cores
from extrap_train.matching import Matcher
from extrap_train.matching.matchers import matcher

Model = TypeVar("Model")


@dataclass(frozen=True)
class PrepModels:
    """A depth source and a matcher, as options or ready.

    Ready ones are sent along with every job, so they must not hold a network.
    """

    depth: DepthConfig | DepthSource
    correction: MatcherConfig | Matcher | None
    """What warps are corrected with; None leaves them."""

    @property
    def depth_identity(self) -> str:
        """What decides about depth: options, and which files of weights they name."""
        return _identity(self.depth)

    @property
    def correction_identity(self) -> str:
        """What decides about corrections; empty where there are none."""
        return "" if self.correction is None else _identity(self.correction)

    def depth_source(self) -> DepthSource:
        """This process's depth source, on its GPU where it has one."""
        if isinstance(self.depth, DepthConfig):
            return _build_cached(depth_source, pickle.dumps(self.depth))
        return self.depth

    def matcher(self) -> Matcher | None:
        """This process's matcher, on its GPU where it has one."""
        if isinstance(self.correction, MatcherConfig):
            return _build_cached(matcher, pickle.dumps(self.correction))
        return self.correction

    def default_workers(self) -> int:
        """One where a network runs on a GPU, whose memory more processes would overfill; else one
        per core."""
        models = (self.depth, self.correction)
        has_network = any(getattr(model, "has_network", False) for model in models)
        if has_network and fastest_device().type == "cuda":
            return 1
        return available_cores()

    def check(self) -> None:
        """Raises InputError where weights cannot be used, without taking a GPU's memory."""
        cpu = torch.device("cpu")
        if isinstance(self.depth, DepthConfig):
            depth_source(self.depth, cpu)
        if isinstance(self.correction, MatcherConfig):
            matcher(self.correction, device=cpu)


def _identity(model: object) -> str:
    return f"{model!r} {[(str(file), file_stamp(file)) for file in weight_files(model)]}"


def release_models() -> None:
    """Free this process's depth source and matcher: training needs the memory."""
    _build_cached.cache_clear()


@lru_cache(maxsize=2)
def _build_cached(build: Callable[[Any], Model], options: bytes) -> Model:
    """Cached by the options' bytes: options are mutable and have no hash."""
    return build(pickle.loads(options))
