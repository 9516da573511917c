"""What a comparison table is made of: captures, protocol, methods, metrics."""

from dataclasses import dataclass, field
from typing import Any

from extrap_train.config.launcher import SlurmConfig
from extrap_train.config.tree import MISSING

CAPTURE_SOURCES = ("synthetic", "co3d", "reconfusion", "scenes")
DRAWS = ("random", "spread", "one_sided", "given")
LPIPS_NETS = ("alex", "vgg", "squeeze")


@dataclass
class CapturesConfig:
    """Which test captures a table is measured on."""

    source: str = "synthetic"
    """`synthetic`, `co3d`, `reconfusion` (transforms.json with train_test_split_N.json, a folder a
    scene) or `scenes` (any capture that `scene=` takes).
    """
    root: str | None = None
    """Folder of the data set; rendered captures are made where it is null."""
    categories: list[str] = field(default_factory=list)
    sequences: int = 4
    """Test sequences a category."""
    scenes: list[str] = field(default_factory=list)
    """For `scenes`: captures, as `scene=` takes them."""
    frames: int = 24
    """Photographs around a rendered scene."""
    render_size: int = 128
    """Pixels a side of a rendered photograph."""
    seed: int = 0
    """Of the rendered scenes."""


@dataclass
class RulesConfig:
    """What every method of a table is measured by; part of every result's hash."""

    image_size: int = 64
    """Pixels a side of inputs, targets and everything that is scored."""
    fine_scale: int = 2
    """Side of the inputs' finer copy over `image_size`, where the photographs are as large: what
    warps, and so the masks, are made from. Every method is given both.
    """
    pool: int = 9
    """Frames that farthest-point sampling picks from a capture (paper III-A.1)."""
    views: list[int] = field(default_factory=lambda: [3, 6])
    """Inputs; the rest of the pool are targets."""
    draws: list[str] = field(default_factory=lambda: ["random", "spread", "one_sided"])
    """How the inputs are drawn from the pool."""
    seeds: list[int] = field(default_factory=lambda: [0])
    """Of the draws, and of the methods' own randomness."""
    depth: str = "dataset"
    """Where the inputs' depth comes from: `dataset` or `stereo`."""


@dataclass
class ScoringConfig:
    """Which perceptual networks judge, and where their weights lie."""

    lpips: list[str] = field(default_factory=lambda: ["alex"])
    """Backbones, each its own column: `alex`, `vgg`, `squeeze`."""
    lpips_weights: dict[str, str] = field(default_factory=dict)
    """Full `lpips.LPIPS` state dicts by net; a net that is not named takes torch's hub cache."""
    dists: bool = True
    """DISTS takes torchvision's VGG-16 from torch's hub cache."""


@dataclass
class QuickConfig:
    """What `--quick` keeps of a table."""

    categories: list[str] = field(default_factory=list)
    sequences: int = 1


@dataclass
class TableConfig:
    """One comparison, `conf/table/NAME.yaml`."""

    name: str = MISSING
    title: str = ""
    captures: CapturesConfig = field(default_factory=CapturesConfig)
    rules: RulesConfig = field(default_factory=RulesConfig)
    scoring: ScoringConfig = field(default_factory=ScoringConfig)
    methods: list[str] = field(default_factory=list)
    """Rows, in their order: names of `conf/method/`."""
    options: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Options by method, over those of the method's own file: `options.ours.weights=FOLDER`."""
    draws: list[str] = field(default_factory=lambda: ["random"])
    """Which of the protocol's draws are run."""
    quick: QuickConfig = field(default_factory=QuickConfig)
    columns: list[str] = field(default_factory=list)
    """Metrics of the printed table, in their order; the CSV holds them all."""
    reported: str | None = None
    """Name of the published numbers that stand beside ours: a file of `conf/reported/`."""
    output: str = "results"
    device: str = "auto"
    """`cpu`, `cuda`, or `auto`: CUDA where there is one."""
    slurm: SlurmConfig = field(default_factory=SlurmConfig)
    """Of `--slurm`: `slurm.partition=NAME slurm.hours=2`."""


@dataclass
class MethodConfig:
    """One row, `conf/method/NAME.yaml`."""

    name: str = MISSING
    title: str = ""
    factory: str = MISSING
    """`package.module.Class`; its fields are the options."""
    group: str = ""
    """Heading that the row stands under."""
    time: str = "in all"
    """What perform time means: `in all` or `per image` (paper III-A.2)."""
    needs: str = ""
    """What it cannot run without, in words, for the list: weights, GPU."""
    options: dict[str, Any] = field(default_factory=dict)
