"""A depth source from its options."""

from pathlib import Path

import torch

from extrap_train.config import (
    AlikedMatcherConfig,
    DatasetDepthConfig,
    DepthConfig,
    FilesDepthConfig,
    LoftrMatcherConfig,
    Mast3rConfig,
    Mast3rMatcherConfig,
    MonocularConfig,
    OwnDepthConfig,
    OwnMatcherConfig,
    StereoConfig,
    required_file,
    required_folder,
)
from extrap_train.depth import DatasetDepth, DepthSource
from extrap_train.depth.depth_folder import SUFFIXES
from extrap_train.depth.files import FilesDepth
from extrap_train.depth.mast3r.network.mast3r_checkpoint import read_network
from extrap_train.depth.mast3r.source import Mast3rDepth
from extrap_train.depth.monocular import MonocularDepth
from extrap_train.depth.stereo import PlaneSweepStereo
from extrap_train.device import fastest_device
from extrap_train.errors import InputError
from extrap_train.factories import files_of, make_object
from extrap_train.matching.matchers import matcher


def depth_source(config: DepthConfig, device: torch.device | None = None) -> DepthSource:
    """The source that the type of `config` stands for; InputError where its weights cannot be used.

    A network runs on `device`; by default on the GPU where there is one.
    """
    device = device or fastest_device()
    match config:
        case DatasetDepthConfig():
            return DatasetDepth()
        case StereoConfig():
            return PlaneSweepStereo(config)
        case Mast3rConfig():
            path = required_file(config.checkpoint, "depth.checkpoint", config.weights)
            return Mast3rDepth(config, read_network(Path(path)).to(device))
        case MonocularConfig():
            # transformers takes seconds to load: only where it is wanted.
            from extrap_train.depth.depth_anything import read_depth_anything

            network = read_depth_anything(config.model, device)
            found = matcher(config.matcher, "depth.matcher", device)
            return MonocularDepth(config, network, found)
        case FilesDepthConfig():
            folder = required_folder(config.folder, "depth.folder", "the folder of the depth maps")
            if not any(file.suffix in SUFFIXES for file in folder.rglob("*")):
                raise InputError(
                    f"depth.folder={folder}: holds no depth map ({', '.join(SUFFIXES)}); add "
                    "them, or use depth=stereo"
                )
            is_affine = config.align == "affine"
            matching = matcher(config.matcher, "depth.matcher", device) if is_affine else None
            return FilesDepth(config, folder, matching)
        case OwnDepthConfig():
            name, prefix = f"depth={config.name}", "depth.options."
            own: DepthSource = make_object(
                config.factory, config.options, name, DepthSource, prefix
            )
            return own
        case _:
            raise InputError(f"depth={config.name}: is not a depth source that this project knows")


def weight_files(options: object) -> list[Path]:
    """The files that decide what a source or a matcher says: weights, depth maps, code of yours."""
    match options:
        case Mast3rConfig() | Mast3rMatcherConfig() | LoftrMatcherConfig() | AlikedMatcherConfig():
            return [Path(options.checkpoint or "")]
        case MonocularConfig():
            from extrap_train.depth.depth_anything import files_read

            return [*files_read(options.model), *weight_files(options.matcher)]
        case FilesDepthConfig():
            files = sorted(path for path in Path(options.folder or "").rglob("*") if path.is_file())
            return files + (weight_files(options.matcher) if options.align == "affine" else [])
        case OwnDepthConfig() | OwnMatcherConfig():
            return files_of(options.factory, options.options)
        case _:
            return []


def source_of_generated(config: DepthConfig) -> DepthConfig:
    """What gives generated views their depth: stereo where `config` knows photographs' alone."""
    brought = isinstance(config, DatasetDepthConfig | FilesDepthConfig)
    return StereoConfig() if brought else config
