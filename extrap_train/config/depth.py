"""Where depth comes from."""

from dataclasses import dataclass
from typing import ClassVar

from extrap_train.config.matching import MatcherConfig
from extrap_train.config.options import MISSING, option


@dataclass
class DepthConfig:
    """Where depth comes from; one subclass per source."""

    name: str = MISSING


@dataclass
class DatasetDepthConfig(DepthConfig):
    """The depth that the data set brings."""

    name: str = "dataset"


@dataclass
class StereoConfig(DepthConfig):
    """Plane-sweep multi-view stereo for known poses."""

    name: str = "stereo"
    planes: int = option(96, "depth hypotheses, evenly spaced in inverse depth", low=3, high=4096)
    neighbours: int = option(4, "other views that vote", low=1, high=64)
    image_size: int = option(
        256, "longer side that depth is estimated at", unit="pixels", low=16, high=8192
    )


@dataclass
class Mast3rConfig(DepthConfig):
    """MASt3R's or DUSt3R's point maps of view pairs."""

    name: str = "mast3r"
    checkpoint: str | None = option(None, "file of weights; required")
    weights: ClassVar[str] = (
        "weights of MASt3R or DUSt3R, for instance "
        "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth of github.com/naver/mast3r"
    )
    neighbours: int = option(4, "most pairs per view", low=1, high=64)
    image_size: int = option(
        512,
        "longer side that the network sees: what its weights were trained on",
        unit="pixels",
        low=16,
        high=8192,
    )
    square: bool = option(
        False,
        "show square pictures whole; the 512-pixel weights know 4:3 and wider, so they are cut "
        "to that otherwise",
    )


@dataclass
class MonocularConfig(DepthConfig):
    """Depth Anything, its scale and shift from matches at the known poses."""

    name: str = "monocular"
    model: str = option(
        "depth-anything/Depth-Anything-V2-Small-hf",
        "folder of a transformers model, or a name in the cache of downloads",
    )
    matcher: MatcherConfig = MISSING
    """matcher@depth.matcher=aliked chooses another."""
    neighbours: int = option(4, "most other views that a view is matched with", low=1, high=64)
