"""Which matcher finds the same points in two pictures."""

from dataclasses import dataclass
from typing import ClassVar

from extrap_train.config.tree import MISSING


@dataclass
class MatcherConfig:
    """How points of one picture are found in another; one subclass a matcher."""

    name: str = MISSING


@dataclass
class FlowMatcherConfig(MatcherConfig):
    """Dense inverse search: a flow for every pixel, without any weights."""

    name: str = "flow"
    image_size: int = 512
    """Longest side that is matched at, in pixels; smaller pictures are enlarged up to twice."""


@dataclass
class LoftrMatcherConfig(MatcherConfig):
    """LoFTR with MINIMA's weights: semi-dense, across modalities and wide baselines."""

    name: str = "loftr"
    checkpoint: str | None = None
    """File of weights; needed."""
    image_size: int = 640
    """Longer side that is matched at, in pixels."""
    weights: ClassVar[str] = (
        "minima_loftr.ckpt of github.com/LSXI7/MINIMA (or LoFTR's own, of github.com/zju3dv/LoFTR)"
    )


@dataclass
class AlikedMatcherConfig(MatcherConfig):
    """ALIKED's keypoints, matched by their descriptors: sparse, across wide baselines."""

    name: str = "aliked"
    checkpoint: str | None = None
    """File of weights; needed."""
    image_size: int = 1024
    """Longest side that is matched at, in pixels; smaller pictures stay as they are."""
    keypoints: int = 4096
    """Most keypoints of a picture."""
    weights: ClassVar[str] = "aliked-n16.pth of github.com/Shiaoming/ALIKED"
