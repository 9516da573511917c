"""The configuration tree as plain dataclasses: every option, its type, its unit and its bounds.

Light on purpose (no torch), so that `--help` is instant. YAMLs under `conf/` choose among the
variants of a group; this file says what may stand in them.
"""

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from extrap_train.errors import InputError

MISSING: Any = "???"  # OmegaConf's mark for "must be given"

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
    train_sequences: int = 40
    frames: int = 24
    """Photographs around each scene."""
    image_size: int = 128
    """Pixels of the square photographs."""
    seed: int = 0


@dataclass
class Co3dConfig(DataConfig):
    """A CO3D v1 or v2 download."""

    name: str = "co3d"
    test_sequences: int = 5
    """Drawn by a hash of the sequence's name; a lone sequence holds out frames instead."""


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


@dataclass
class PrepConfig:
    """Which sequences and pairs become training data (paper III-A.1)."""

    image_size: int = 64
    """Side of the stored square frames, in pixels: the model's resolution."""
    max_gap_deg: float = 30.0
    """Largest azimuth gap between neighbouring cameras of a 360° sequence."""
    min_coverage_deg: float = 300.0
    """Least azimuth covered around the fitted orbit axis."""
    min_viewpoint_quality: float = 0.0
    min_point_cloud_quality: float = -2.0
    max_uses: int = 16
    """Most pairs that one frame takes part in."""
    min_pair_angle_deg: float = 8.0
    max_pair_angle_deg: float = 88.0
    near_duplicate_deg: float = 6.0
    """A pair is skipped if a chosen one has both its frames within this angle of its own."""
    full_circle: str = "prefer"
    """No full circle: `require` drops it, `prefer` unless nothing is one, `ignore` never."""


NORM_GROUPS = 16
"""Groups of the denoiser's normalisations: the widths of its levels are multiples of it."""


@dataclass
class UNetConfig:
    """Shape of the denoiser (diffusers' `UNet2DConditionModel`)."""

    channels: list[int] = field(default_factory=lambda: [32, 64, 128, 192])
    layers_per_block: int = 1
    attention_levels: list[bool] = field(default_factory=lambda: [False, False, False, True])
    heads: int = 4
    token_width: int = 192
    """Width of the one cross-attention token."""


@dataclass
class ModelConfig:
    """A denoiser with its conditioning (METHOD: paper II-B)."""

    name: str = MISSING
    image_size: int = 64
    patch: int = 2
    """Pixels a side that become channels of one latent: the small model's stand-in for a VAE."""
    references: int = 3
    """Most references that a view is warped from (paper III-A.4)."""
    octaves: int = 4
    """Of the positional encoding: 4 channels each."""
    residual: bool = True
    """Denoise the difference to the hole-filled warp instead of the image itself."""
    prediction: str = "sample"
    """`epsilon`, `v_prediction` or `sample`."""
    zero_terminal_snr: bool = True
    unet: UNetConfig = field(default_factory=UNetConfig)
    learning_rate: float = 3e-4
    weight_decay: float = 0.01
    start: str | None = None
    """Folder that training starts from; `base` is the packaged model, null random weights."""


@dataclass
class SamplerConfig:
    """How a view is sampled (DDIM)."""

    steps: int = 2
    eta: float = 0.0
    guidance: float = 1.0
    """Weight of the conditional prediction against the null condition's; 1 is no guidance."""


@dataclass
class TrainerConfig:
    """How long, how often, on what."""

    steps: int = 1200
    batch_size: int = 16
    warmup_steps: int = 100
    condition_dropout: float = 0.05
    """Share of the training examples whose condition is the null condition."""
    ema_decay: float = 0.999
    precision: str = "bf16-mixed"
    accelerator: str = "auto"
    devices: int = 1
    checkpoint_every: int = 200
    """Steps; a killed run loses at most this many."""
    validate_every: int = 400
    workers: int = 0
    """Processes that load batches beside the training process."""


@dataclass
class ValidationConfig:
    """What the trained model is measured on: held-out sequences."""

    examples: int = 60
    batch_size: int = 20
    pictures: int = 8
    lpips_weights: str | None = None
    """A full `lpips.LPIPS(net="squeeze")` state dict; null takes torchvision's cached backbone."""


@dataclass
class TrainConfig:
    """The whole tree of `python -m extrap_train`."""

    category: CategoryConfig = MISSING
    data: DataConfig = MISSING
    depth: DepthConfig = MISSING
    model: ModelConfig = MISSING
    prep: PrepConfig = field(default_factory=PrepConfig)
    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    task: str = "category"
    seed: int = 0
    run: str | None = None
    """Name of the run's folder; by default made from the configuration, so that the same command
    resumes.
    """
    resume: bool = True
    output: str = "outputs"
    threads: int | None = None
    """CPU threads; null takes every core."""


@dataclass
class DataPrepConfig:
    """The whole tree of `python -m data_prep`."""

    category: CategoryConfig = MISSING
    data: DataConfig = MISSING
    depth: DepthConfig = MISSING
    prep: PrepConfig = field(default_factory=PrepConfig)
    output: str = "outputs"
    workers: int | None = None
    """Sequences that are rendered or prepared at a time; null takes every core."""


def dotted(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested mapping as one of dotted keys."""
    items: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            items |= dotted(value, f"{prefix}{key}.")
        else:
            items[prefix + key] = value
    return items


_PRECISIONS = ("32-true", "bf16-mixed", "16-mixed", "bf16-true", "16-true", "64-true")

_BOUNDS: dict[str, tuple[float, float]] = {
    "seed": (0, 2**30),
    "threads": (1, math.inf),
    "workers": (1, math.inf),
    "data.test_sequences": (1, 10_000),
    "data.train_sequences": (1, 10_000),
    "data.frames": (2, 10_000),
    "data.image_size": (8, 8192),
    "data.seed": (0, 2**30),
    "depth.planes": (2, 4096),
    "depth.neighbours": (1, 64),
    "depth.image_size": (16, 8192),
    "prep.image_size": (1, 4096),
    "prep.max_uses": (1, math.inf),
    "model.patch": (1, 64),
    "model.references": (1, 16),
    "model.octaves": (1, 16),
    "model.unet.layers_per_block": (1, 16),
    "model.unet.heads": (1, 64),
    "model.unet.token_width": (1, 8192),
    "sampler.steps": (1, 1000),
    "sampler.eta": (0, 1),
    "trainer.steps": (1, math.inf),
    "trainer.batch_size": (1, math.inf),
    "trainer.warmup_steps": (0, math.inf),
    "trainer.condition_dropout": (0, 1),
    "trainer.ema_decay": (0, 1),
    "trainer.devices": (1, math.inf),
    "trainer.checkpoint_every": (1, math.inf),
    "trainer.validate_every": (1, math.inf),
    "trainer.workers": (0, 1024),
    "validation.examples": (1, math.inf),
    "validation.batch_size": (1, math.inf),
    "validation.pictures": (1, math.inf),
}
"""Least and greatest value of every number whose range its type does not say."""


def validate(config: TrainConfig | DataPrepConfig, tasks: tuple[str, ...]) -> None:
    """Check what types cannot say; raises InputError with option, value and remedy."""
    _check_bounds(config)
    _check_prep(config.prep)
    if isinstance(config.data, Co3dConfig) and not config.data.root:
        raise InputError("data=co3d needs the folder of the download: give data.root=FOLDER")
    if isinstance(config, TrainConfig):
        _check_one_of("task", config.task, tasks)
        _check_one_of("trainer.precision", config.trainer.precision, _PRECISIONS)
        _check_model(config.model, config.prep)


def _check_bounds(config: TrainConfig | DataPrepConfig) -> None:
    for name, value in dotted(asdict(config)).items():
        least, greatest = _BOUNDS.get(name, (-math.inf, math.inf))
        if not isinstance(value, int | float) or least <= value <= greatest:
            continue
        if greatest == math.inf:
            raise InputError(f"{name}={value}: must be at least {least:g}")
        raise InputError(f"{name}={value}: must be from {least:g} to {greatest:g}")


def _check_prep(prep: PrepConfig) -> None:
    _check_one_of("prep.full_circle", prep.full_circle, ("require", "prefer", "ignore"))
    if not 0 <= prep.min_pair_angle_deg < prep.max_pair_angle_deg <= 90:
        raise InputError(
            f"prep.min_pair_angle_deg={prep.min_pair_angle_deg} and "
            f"prep.max_pair_angle_deg={prep.max_pair_angle_deg}: need 0 ≤ min < max ≤ 90"
        )


def _check_model(model: ModelConfig, prep: PrepConfig) -> None:
    _check_one_of("model.prediction", model.prediction, ("epsilon", "v_prediction", "sample"))
    if model.image_size != prep.image_size:
        raise InputError(
            f"model.image_size={model.image_size} but "
            f"prep.image_size={prep.image_size}: give both the same"
        )
    odd = [width for width in model.unet.channels if width <= 0 or width % NORM_GROUPS]
    if odd or not model.unet.channels:
        raise InputError(
            f"model.unet.channels={model.unet.channels}: need multiples of {NORM_GROUPS}"
        )
    coarsest = model.patch * 2 ** (len(model.unet.channels) - 1)
    if model.image_size % coarsest:
        raise InputError(
            f"model.image_size={model.image_size} is no multiple of {coarsest}, "
            "which model.patch and the levels of model.unet.channels need"
        )
    if len(model.unet.channels) != len(model.unet.attention_levels):
        raise InputError("model.unet.channels and model.unet.attention_levels differ in length")
    if model.zero_terminal_snr and model.prediction == "epsilon":
        raise InputError(
            "model.prediction=epsilon says nothing at zero terminal SNR: "
            "give model.zero_terminal_snr=false"
        )


def _check_one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise InputError(f"{name}={value} is unknown; known: {', '.join(known)}")
