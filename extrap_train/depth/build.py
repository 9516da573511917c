"""A depth source from its options."""

from extrap_train.config import DatasetDepthConfig, DepthConfig, StereoConfig
from extrap_train.depth import DepthSource
from extrap_train.depth.dataset import DatasetDepth
from extrap_train.depth.stereo import PlaneSweepStereo
from extrap_train.errors import InputError


def depth_source(config: DepthConfig) -> DepthSource:
    """The source that the type of `config` stands for."""
    match config:
        case DatasetDepthConfig():
            return DatasetDepth()
        case StereoConfig():
            return PlaneSweepStereo(config)
        case _:
            raise InputError(f"depth={config.name}: unknown; choose dataset or stereo")
