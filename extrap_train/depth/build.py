"""A depth source from its options."""

from pathlib import Path

from extrap_train.config import (
    DatasetDepthConfig,
    DepthConfig,
    Mast3rConfig,
    MonocularConfig,
    StereoConfig,
    required_file,
)
from extrap_train.depth import DepthSource
from extrap_train.depth.dataset import DatasetDepth
from extrap_train.depth.mast3r.checkpoint import read_network
from extrap_train.depth.mast3r.source import Mast3rDepth
from extrap_train.depth.monocular import MonocularDepth
from extrap_train.depth.stereo import PlaneSweepStereo
from extrap_train.device import fastest_device
from extrap_train.errors import InputError
from extrap_train.matching.build import matcher


def depth_source(config: DepthConfig) -> DepthSource:
    """The source that the type of `config` stands for; InputError where its weights cannot be used.

    A network runs on the GPU where there is one.
    """
    match config:
        case DatasetDepthConfig():
            return DatasetDepth()
        case StereoConfig():
            return PlaneSweepStereo(config)
        case Mast3rConfig():
            path = required_file(config.checkpoint, "depth.checkpoint", config.weights)
            return Mast3rDepth(config, read_network(Path(path)).to(fastest_device()))
        case MonocularConfig():
            # transformers takes seconds to load: only where it is wanted.
            from extrap_train.depth.depth_anything import read_depth_anything

            network = read_depth_anything(config.model)
            return MonocularDepth(config, network, matcher(config.matcher, "depth.matcher"))
        case _:
            raise InputError(
                f"depth={config.name}: unknown; choose dataset, stereo, mast3r or monocular"
            )
