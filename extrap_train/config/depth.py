"""Where depth comes from."""

from dataclasses import dataclass

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
    """Depth hypotheses, evenly spaced in inverse depth."""
    neighbours: int = 4
    """Other views that vote."""
    image_size: int = 256
    """Longer side that depth is estimated at, in pixels."""
