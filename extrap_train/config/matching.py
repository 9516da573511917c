"""Which matcher finds the same points in two pictures."""

from dataclasses import dataclass
from typing import ClassVar

from extrap_train.config.options import MISSING, option


@dataclass
class MatcherConfig:
    """How points of one picture are found in another; one subclass per matcher."""

    name: str = MISSING


@dataclass
class FlowMatcherConfig(MatcherConfig):
    """Dense inverse search: a flow for every pixel, without any weights."""

    name: str = "flow"
    image_size: int = option(
        512,
        "longest side that is matched at; smaller pictures are enlarged up to twice",
        unit="pixels",
        low=16,
        high=8192,
    )


@dataclass
class LoftrMatcherConfig(MatcherConfig):
    """LoFTR with MINIMA's weights: semi-dense, across modalities and wide baselines."""

    name: str = "loftr"
    checkpoint: str | None = option(None, "file of weights; required")
    image_size: int = option(
        640, "longer side that is matched at", unit="pixels", low=16, high=8192
    )
    weights: ClassVar[str] = (
        "minima_loftr.ckpt of github.com/LSXI7/MINIMA (or LoFTR's own, of github.com/zju3dv/LoFTR)"
    )


@dataclass
class AlikedMatcherConfig(MatcherConfig):
    """ALIKED's keypoints, matched by their descriptors: sparse, across wide baselines."""

    name: str = "aliked"
    checkpoint: str | None = option(None, "file of weights; required")
    image_size: int = option(
        1024,
        "longest side that is matched at; smaller pictures stay as they are",
        unit="pixels",
        low=16,
        high=8192,
    )
    keypoints: int = option(4096, "most keypoints per picture", low=2, high=20_000)
    weights: ClassVar[str] = "aliked-n16.pth of github.com/Shiaoming/ALIKED"
