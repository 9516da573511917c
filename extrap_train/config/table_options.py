"""What a comparison table is made of: captures, protocol, methods, metrics."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from extrap_train.config.commands import SlurmConfig
from extrap_train.config.options import MISSING, option

CAPTURE_SOURCES = ("synthetic", "co3d", "folders", "reconfusion", "scenes")
DRAWS = ("random", "spread", "one_sided", "halves", "given")
LPIPS_NETS = ("alex", "vgg", "squeeze")
_SSIM_WINDOW = 11
_HIGHER_IS_BETTER = (
    "psnr", "ssim", "masked_psnr", "masked_ssim", "unseen_psnr", "unseen_ssim", "compat_psnr",
    "compat_ssim", "tsed", "warp_psnr", "completeness", "accuracy_share", "f_score",
)  # fmt: skip
_LOWER_IS_BETTER = ("dists", "seconds", *(f"lpips_{net}" for net in LPIPS_NETS))
_SAME_FOR_ALL_METHODS = ("coverage", "tsed_truth", "warp_psnr_truth")
_UNRANKED = ("peak_memory_mib", "accuracy_distance")
"""Memory depends on the machine, and the distance is of those points alone that a method has, which
may be few and good.
"""
METRICS = (*_HIGHER_IS_BETTER, *_LOWER_IS_BETTER, *_SAME_FOR_ALL_METHODS, *_UNRANKED)


@dataclass
class MetricConfig:
    """A metric of your own, `conf/metric/NAME.yaml`."""

    factory: str = MISSING
    """`package.module.Class`; its fields are the options."""
    better: str = option(
        "neither", "which values of the metric are better", choices=("higher", "lower", "neither")
    )
    options: dict[str, Any] = field(default_factory=dict)


def metric_direction(metric: str, own: Mapping[str, MetricConfig] | None = None) -> int:
    """1 where higher is better, -1 where lower is, 0 for a number that ranks no method.

    `own` are the metrics of a table that are not the package's.
    """
    if own and metric in own:
        return {"higher": 1, "lower": -1}.get(own[metric].better, 0)
    if metric in _HIGHER_IS_BETTER:
        return 1
    return -1 if metric in _LOWER_IS_BETTER or metric.startswith("lpips") else 0


@dataclass
class CapturesConfig:
    """Which test captures a table is measured on."""

    source: str = option(
        "synthetic",
        "data set: rendered, CO3D, your own folders as data=folders reads them, folders with "
        "transforms.json and train_test_split_N.json, or anything that scene= takes",
        choices=CAPTURE_SOURCES,
    )
    root: str | None = option(None, "folder of the data set; null renders the captures")
    categories: list[str] = option([], "categories that are measured", is_set=True)
    sequences: int = option(4, "test sequences per category", low=1, high=10_000)
    scenes: list[str] = option(
        [], "captures of captures.source=scenes, as scene= takes them", is_set=True
    )
    frames: int = option(24, "photographs around a rendered scene", low=1, high=10_000)
    render_size: int = option(128, "side of a rendered photograph", unit="pixels", low=1, high=8192)
    seed: int = option(0, "seed of the rendered scenes", low=0, high=2**30)


@dataclass
class RulesConfig:
    """What every method of a table is measured by; part of every result's hash."""

    image_size: int = option(
        64,
        "side of inputs, targets and everything that is scored",
        unit="pixels",
        low=_SSIM_WINDOW,
        high=4096,
    )
    fine_scale: int = option(
        2,
        "side of the inputs' finer copy, which warps and masks are made from, as a multiple of "
        "rules.image_size",
        low=1,
        high=64,
    )
    pool: int = option(
        9, "frames that farthest-point sampling picks from a capture", low=2, high=10_000
    )
    views: list[int] = option(
        [3, 6],
        "numbers of inputs; the rest of the pool are targets",
        is_set=True,
        low=1,
        high=10_000,
    )
    draws: list[str] = option(
        ["random", "spread", "one_sided"],
        "how the inputs may be drawn from the pool; halves: inputs from one half of the capture, "
        "targets from the other",
        is_set=True,
        choices=DRAWS,
    )
    seeds: list[int] = option(
        [0], "seeds of the draws and of the methods' own randomness", is_set=True, low=0, high=2**30
    )
    depth: str = option(
        "stereo",
        "where the inputs' depth comes from: a choice of depth= in the other commands; dataset "
        "makes the table an oracle",
    )

    @property
    def is_oracle(self) -> bool:
        """Whether methods learn more about a capture than its inputs show."""
        return self.depth == "dataset"


@dataclass
class ScoringConfig:
    """What judges images besides the usual metrics: perceptual networks, and metrics of yours."""

    lpips: list[str] = option(
        ["alex"], "LPIPS backbones, one column each", choices=LPIPS_NETS, is_set=True
    )
    lpips_weights: dict[str, str] = option(
        {},
        "full lpips.LPIPS state dicts by net; a net not named takes torch's hub cache",
        choices=LPIPS_NETS,
    )
    dists: bool = option(True, "measure DISTS, with torchvision's VGG-16 from torch's hub cache")
    metrics: list[str] = option(
        [], "metrics of your own: names of files below metric/ in --config-dir", is_set=True
    )
    own: dict[str, MetricConfig] = option({}, "what these files say; not to be set")

    @property
    def judged(self) -> list[str]:
        """The columns that a network judges."""
        return [*(f"lpips_{net}" for net in self.lpips), *(["dists"] if self.dists else [])]


@dataclass
class QuickConfig:
    """What `--quick` keeps of a table."""

    categories: list[str] = option(
        [], "categories that --quick keeps, unless captures are named", is_set=True
    )
    sequences: int = option(1, "sequences per category that --quick keeps", low=1, high=10_000)


@dataclass
class TableConfig:
    """One comparison, `conf/table/NAME.yaml`."""

    name: str = option(MISSING, "name of the table's folder below output")
    title: str = option("", "heading of the reports")
    captures: CapturesConfig = field(default_factory=CapturesConfig)
    rules: RulesConfig = field(default_factory=RulesConfig)
    scoring: ScoringConfig = field(default_factory=ScoringConfig)
    methods: list[str] = option(
        [], "rows in their order: names of `benchmark list methods`", is_set=True
    )
    options: dict[str, dict[str, Any]] = option(
        {}, "options by method, as options.ours.weights=FOLDER; they replace those of its file"
    )
    draws: list[str] = option(
        ["random"], "which of rules.draws are run", choices=DRAWS, is_set=True
    )
    quick: QuickConfig = field(default_factory=QuickConfig)
    columns: list[str] = option(
        [],
        "metrics of the printed table in their order; the CSV holds all of them",
        is_set=True,
    )
    reported: str | None = option(
        None, "published numbers to print next to ours: a file of conf/reported/"
    )
    output: str = option("results", "folder of all results")
    device: str = option(
        "auto",
        "device of the methods; auto: CUDA if there is one",
        choices=("auto", "cpu", "cuda"),
    )
    cell_timeout_s: float = option(
        6 * 3600.0, "most time that a method may take for one cell", unit="s", low=1, high=1e7
    )
    slurm: SlurmConfig = field(default_factory=SlurmConfig)


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
