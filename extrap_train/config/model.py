"""The denoiser with its conditioning, and how views are sampled."""

from dataclasses import dataclass, field

from extrap_train.config.tree import MISSING

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
