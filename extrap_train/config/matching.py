"""Which matcher finds the same points in two pictures."""

from dataclasses import dataclass

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
