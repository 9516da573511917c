"""Where photographs, matches and depth come from, and what becomes training data."""

from dataclasses import dataclass
from typing import Any, ClassVar

from extrap_train.config.options import MISSING, option


@dataclass
class CategoryConfig:
    """What the model is trained on: one category, or several for a base model."""

    name: str = option(MISSING, "name of the category in results")
    members: list[str] = option([], "CO3D's names of the categories: one, or several")


@dataclass
class DataConfig:
    """Where sequences come from; one subclass per source."""

    name: str = MISSING
    root: str | None = option(None, "folder of the data set; null renders synthetic data")


@dataclass
class SyntheticConfig(DataConfig):
    """Rendered sequences in CO3D's layout, the same on every machine."""

    name: str = "synthetic"
    test_sequences: int = option(
        5, "sequences 0 to n-1, which are always for testing", low=1, high=10_000
    )
    train_sequences: int = option(100, "sequences after those, for training", low=1, high=10_000)
    frames: int = option(24, "photographs around each scene", low=2, high=10_000)
    image_size: int = option(
        128,
        "side of the rendered photographs; views are generated at model.image_size",
        unit="pixels",
        low=8,
        high=8192,
    )
    seed: int = option(0, "seed of shapes, materials, light and camera paths", low=0, high=2**30)


@dataclass
class DownloadConfig(DataConfig):
    """Captures that are on disk: a downloaded data set, or your own."""

    test_sequences: int = option(
        5,
        "test sequences, drawn by a hash of their names; a lone sequence holds out frames instead",
        low=1,
        high=10_000,
    )


@dataclass
class Co3dConfig(DownloadConfig):
    """A CO3D v1 or v2 download."""

    name: str = "co3d"
    set_list: str | None = option(
        None, "one of CO3D's own splits instead, as fewview_dev: its train and test sequences only"
    )


@dataclass
class Uco3dConfig(DownloadConfig):
    """A uCO3D download."""

    name: str = "uco3d"


@dataclass
class FoldersConfig(DownloadConfig):
    """Captures of your own: a folder per category, in it a folder, archive or video per capture."""

    name: str = "folders"


@dataclass
class PrepConfig:
    """Which sequences and pairs become training data (paper III-A.1)."""

    image_size: int = option(
        128,
        "side of the stored frames, which warps are made at: model.warp_scale x model.image_size",
        unit="pixels",
        low=1,
        high=4096,
    )
    max_gap_deg: float = option(
        30.0,
        "largest azimuth gap between neighbouring cameras of a full circle",
        unit="degrees",
        low=0,
        high=360,
    )
    min_coverage_deg: float = option(
        300.0,
        "least azimuth that a full circle covers around the fitted orbit axis",
        unit="degrees",
        low=0,
        high=360,
    )
    min_viewpoint_quality: float = option(
        0.0,
        "least of CO3D's own score of a sequence's cameras, if there is one",
        low=-1e3,
        high=1e3,
    )
    min_point_cloud_quality: float = option(
        -2.0,
        "least of CO3D's own score of a sequence's point cloud, if there is one",
        low=-1e3,
        high=1e3,
    )
    max_uses: int = option(16, "most pairs that one frame takes part in", low=1)
    min_pair_angle_deg: float = option(
        8.0,
        "least angle between the views of a pair, seen from the scene's centre",
        unit="degrees",
        low=0,
        high=90,
    )
    max_pair_angle_deg: float = option(
        88.0, "greatest angle between the views of a pair", unit="degrees", low=0, high=90
    )
    near_duplicate_deg: float = option(
        6.0,
        "skip a pair if both its frames are this close to those of a chosen one",
        unit="degrees",
        low=0,
        high=180,
    )
    full_circle: str = option(
        "prefer",
        "sequences that are not a full circle: drop all, drop all if others are one, or keep them",
        choices=("require", "prefer", "ignore"),
    )
    correct: bool | None = option(
        None,
        "correct training warps by matching them to the photograph; null: unless depth is exact",
    )
    correction_grid: int = option(
        12, "control points of a correction along each side", low=4, high=64
    )


@dataclass
class MatcherConfig:
    """How points of one picture are found in another; one subclass per matcher."""

    name: str = MISSING
    has_network: ClassVar[bool] = True


@dataclass
class FlowMatcherConfig(MatcherConfig):
    """Dense inverse search: a flow for every pixel, without any weights."""

    name: str = "flow"
    has_network: ClassVar[bool] = False
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


_MAST3R_WEIGHTS = "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth of github.com/naver/mast3r"


@dataclass
class Mast3rMatcherConfig(MatcherConfig):
    """MASt3R's descriptors: dense, across wide baselines and weak texture."""

    name: str = "mast3r"
    checkpoint: str | None = option(None, "file of weights; required")
    image_size: int = option(
        512,
        "longer side that the network sees: what its weights were trained on",
        unit="pixels",
        low=16,
        high=8192,
    )
    weights: ClassVar[str] = f"weights of MASt3R, for instance {_MAST3R_WEIGHTS}"


@dataclass
class SiftPosesConfig(MatcherConfig):
    """pycolmap's own SIFT features and matches, for `poses`."""

    name: str = "sift"
    has_network: ClassVar[bool] = False


@dataclass
class OwnMatcherConfig(MatcherConfig):
    """A class with the protocol of `extrap_train/matching`, named by a YAML."""

    name: str = "own"
    factory: str = option(MISSING, "class of a matcher of your own, as package.module.Class")
    options: dict[str, Any] = option({}, "values of the fields of that class")


@dataclass
class DepthConfig:
    """Where depth comes from; one subclass per source."""

    name: str = MISSING
    has_network: ClassVar[bool] = True


@dataclass
class DatasetDepthConfig(DepthConfig):
    """The depth that the data set brings."""

    name: str = "dataset"
    has_network: ClassVar[bool] = False


@dataclass
class StereoConfig(DepthConfig):
    """Plane-sweep multi-view stereo for known poses."""

    name: str = "stereo"
    has_network: ClassVar[bool] = False
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
    weights: ClassVar[str] = f"weights of MASt3R or DUSt3R, for instance {_MAST3R_WEIGHTS}"
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


@dataclass
class FilesDepthConfig(DepthConfig):
    """Depth maps in files that another program has made; see docs/depth_files.md."""

    name: str = "files"
    has_network: ClassVar[bool] = False
    folder: str | None = option(
        None, "folder of depth maps, which are called like the photographs; required"
    )
    align: str = option(
        "scene",
        "what is solved for: one scale per scene or per view, or, for files of inverse depth "
        "(affine), a scale and a shift per view",
        choices=("scene", "view", "affine"),
    )
    max_residual: float = option(
        0.1, "median relative difference from other views beyond which depth is refused", low=0
    )
    image_size: int = option(
        512, "longer side that depth is resampled to", unit="pixels", low=16, high=8192
    )
    matcher: MatcherConfig = MISSING
    """Used by depth.align=affine; matcher@depth.matcher=aliked chooses another."""


@dataclass
class OwnDepthConfig(DepthConfig):
    """A class with the protocol of `extrap_train/depth`, named by a YAML."""

    name: str = "own"
    factory: str = option(MISSING, "class of a depth source of your own, as package.module.Class")
    options: dict[str, Any] = option({}, "values of the fields of that class")
