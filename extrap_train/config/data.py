"""Where photographs come from, and which of them become training data."""

from dataclasses import dataclass, field

from extrap_train.config.tree import MISSING

CATEGORIES = ("apple", "book", "chair", "cup", "hydrant", "teddybear")


@dataclass
class CategoryConfig:
    """What the model is trained on: one category, or several for a base model."""

    name: str = MISSING
    members: list[str] = field(default_factory=list)
    """CO3D's names of the categories; one, but for `all`."""


@dataclass
class DataConfig:
    """Where sequences come from; one subclass a source."""

    name: str = MISSING
    root: str | None = None
    """Folder of the data set; made where the source makes its own."""


@dataclass
class SyntheticConfig(DataConfig):
    """Rendered sequences in CO3D's layout, the same on every machine."""

    name: str = "synthetic"
    test_sequences: int = 5
    """Sequences 0 … n-1 are for testing, whatever else is asked for."""
    train_sequences: int = 100
    """The sequences behind those."""
    frames: int = 24
    """Photographs around each scene."""
    image_size: int = 128
    """Pixels of the square photographs."""
    seed: int = 0
    """Of shapes, materials, light and the walks around them."""


@dataclass
class Co3dConfig(DataConfig):
    """A CO3D v1 or v2 download."""

    name: str = "co3d"
    test_sequences: int = 5
    """Drawn by a hash of the sequence's name; a lone sequence holds out frames instead."""
    set_list: str | None = None
    """CO3D's own division instead, as `fewview_dev`: its train and test sequences, no others."""


@dataclass
class PrepConfig:
    """Which sequences and pairs become training data (paper III-A.1)."""

    image_size: int = 128
    """Side of the stored square frames, in pixels: the size that warps are made at, which is
    `model.warp_scale` times `model.image_size`."""
    max_gap_deg: float = 30.0
    """Largest azimuth gap between neighbouring cameras of a 360° sequence."""
    min_coverage_deg: float = 300.0
    """Least azimuth covered around the fitted orbit axis."""
    min_viewpoint_quality: float = 0.0
    """CO3D's own score of a sequence's cameras, where it has one."""
    min_point_cloud_quality: float = -2.0
    """CO3D's own score of a sequence's point cloud, where it has one."""
    max_uses: int = 16
    """Most pairs that one frame takes part in."""
    min_pair_angle_deg: float = 8.0
    """Least angle between the views of a pair, seen from the scene's centre."""
    max_pair_angle_deg: float = 88.0
    """Greatest angle between the views of a pair."""
    near_duplicate_deg: float = 6.0
    """A pair is skipped if a chosen one has both its frames within this angle of its own."""
    full_circle: str = "prefer"
    """No full circle: `require` drops it, `prefer` unless nothing is one, `ignore` never."""
    correct: bool | None = None
    """Correct training warps by matching them to the truth; null wherever depth is not exact, which
    only that of synthetic data is."""
    correction_grid: int = 12
    """Control points of a correction along each side."""
