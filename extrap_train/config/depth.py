"""Where depth comes from."""

from dataclasses import dataclass
from typing import ClassVar

from extrap_train.config.matching import MatcherConfig
from extrap_train.config.tree import MISSING


@dataclass
class DepthConfig:
    """Where depth comes from; one subclass a source."""

    name: str = MISSING


@dataclass
class DatasetDepthConfig(DepthConfig):
    """The depth that the data set brings."""

    name: str = "dataset"


@dataclass
class StereoConfig(DepthConfig):
    """Plane-sweep multi-view stereo for known poses."""

    name: str = "stereo"
    planes: int = 96
    """Depth hypotheses, evenly spaced in inverse depth; at least 3."""
    neighbours: int = 4
    """Other views that vote."""
    image_size: int = 256
    """Longer side that depth is estimated at, in pixels."""


@dataclass
class Mast3rConfig(DepthConfig):
    """MASt3R's or DUSt3R's point maps of view pairs."""

    name: str = "mast3r"
    checkpoint: str | None = None
    """File of weights; needed."""
    weights: ClassVar[str] = (
        "weights of MASt3R or DUSt3R, for instance "
        "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth of github.com/naver/mast3r"
    )
    neighbours: int = 4
    """Most pairs that a view looks for."""
    image_size: int = 512
    """Longer side that the network sees, in pixels: what its weights were trained on."""
    square: bool = False
    """Show square pictures whole; the published 512-pixel weights know 4:3 and wider only, to which
    squares are cut otherwise: no depth in their upper and lower eighth."""


@dataclass
class MonocularConfig(DepthConfig):
    """Depth Anything, its scale and shift from matches at the known poses."""

    name: str = "monocular"
    model: str = "depth-anything/Depth-Anything-V2-Small-hf"
    """Folder of a model for transformers, or a name in its cache of downloads."""
    matcher: MatcherConfig = MISSING
    """matcher@depth.matcher=aliked chooses another."""
    neighbours: int = 4
    """Most other views that a view is matched with."""
