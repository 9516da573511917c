"""A matcher from its options."""

from pathlib import Path

import torch

from extrap_train.config import (
    AlikedMatcherConfig,
    FlowMatcherConfig,
    LoftrMatcherConfig,
    Mast3rMatcherConfig,
    MatcherConfig,
    OwnMatcherConfig,
    required_file,
)
from extrap_train.device import fastest_device
from extrap_train.errors import InputError
from extrap_train.factories import make_object
from extrap_train.matching import Matcher
from extrap_train.matching.dense_flow import FlowMatcher


def matcher(
    config: MatcherConfig, option: str = "matcher", device: torch.device | None = None
) -> Matcher:
    """The matcher that the type of `config`, given as `option`, stands for.

    A network runs on `device`, by default on the GPU where there is one. InputError where its
    weights cannot be used.
    """
    device = device or fastest_device()
    match config:
        case FlowMatcherConfig():
            return FlowMatcher(config)
        case LoftrMatcherConfig():
            # kornia takes each process a hundred megabytes: only where it is wanted.
            from extrap_train.matching.loftr import LoftrMatcher, read_loftr

            loftr = read_loftr(_weights(config, option), config, f"{option}.checkpoint")
            return LoftrMatcher(config, loftr.to(device))
        case AlikedMatcherConfig():
            from extrap_train.matching.aliked import AlikedMatcher, read_aliked

            aliked = read_aliked(_weights(config, option), config, f"{option}.checkpoint")
            return AlikedMatcher(config, aliked.to(device))
        case Mast3rMatcherConfig():
            from extrap_train.matching.mast3r import Mast3rMatcher, read_mast3r

            mast3r = read_mast3r(_weights(config, option), option)
            return Mast3rMatcher(config, mast3r.to(device), option)
        case OwnMatcherConfig():
            name, prefix = f"{option}={config.name}", f"{option}.options."
            own: Matcher = make_object(config.factory, config.options, name, Matcher, prefix)
            return own
        case _:
            raise InputError(f"{option}={config.name}: is not a matcher that this project knows")


def _weights(
    config: LoftrMatcherConfig | AlikedMatcherConfig | Mast3rMatcherConfig, option: str
) -> Path:
    return Path(required_file(config.checkpoint, f"{option}.checkpoint", config.weights))
