"""The denoiser with its conditioning, and how views are sampled."""

from dataclasses import dataclass, field, replace
from typing import Any

from extrap_train.config.tree import MISSING, require_one_of

FAMILIES = ("zeronvs", "megascenes", "ours")
"""What a denoiser may be told about the query view; `extrap_train.diffusion.family` has each."""
NEAREST_ALONE = ("zeronvs", "megascenes")
"""Families that are told of the nearest reference and of no other."""


@dataclass
class UNetConfig:
    """Shape of the denoiser (diffusers' `UNet2DConditionModel`)."""

    channels: list[int] = field(default_factory=lambda: [32, 64, 128, 192])
    """Width of each level, finest first."""
    layers_per_block: int = 1
    attention_levels: list[bool] = field(default_factory=lambda: [False, False, False, True])
    """Which levels attend, finest first."""
    heads: int = 4
    """Of each attention."""
    token_width: int = 192
    """Width of the one cross-attention token."""
    norm_groups: int = 16
    """Of the normalisations; the widths of the levels are multiples of it."""


@dataclass
class VaeConfig:
    """Shape of the latent space's autoencoder (diffusers' `AutoencoderKL`); Stable Diffusion's."""

    channels: list[int] = field(default_factory=lambda: [128, 256, 512, 512])
    layers_per_block: int = 2


@dataclass
class ClipConfig:
    """Shape of CLIP's image tower at 224² pixels in patches of 14²; ViT-L/14's."""

    width: int = 1024
    layers: int = 24
    heads: int = 16
    embedding_width: int = 768


@dataclass
class SamplerConfig:
    """How a view is sampled; the defaults are the small model's."""

    solver: str = "ddim"
    """`ddim` (paper), or of second order, for few steps: `dpmpp` (DPM-Solver++ 2M), `unipc`."""
    steps: int = 2
    """Evaluations of the denoiser."""
    eta: float = 0.0
    """Share of DDIM's noise that is drawn anew at every step; 0 is deterministic."""
    guidance: float = 1.0
    """Weight of the conditional prediction against the null condition's; 1 is no guidance."""
    guidance_rescale: float = 0.0
    """How far guidance's wider spread is taken back (Lin et al. 2023); they use 0.7."""
    compat: str | None = None
    """`megascenes` samples as ZeroNVS and MegaScenes were published: guidance against plain zeros,
    which their training never saw, and the noisiest step left out.
    """


@dataclass
class SamplerOptions:
    """What a command says of `SamplerConfig`; null leaves it at what the model recommends."""

    solver: str | None = None
    steps: int | None = None
    eta: float | None = None
    guidance: float | None = None
    guidance_rescale: float | None = None
    compat: str | None = None
    without: list[str] = field(default_factory=list)
    """What the model recommends and is not wanted: `compat`."""

    def over(self, recommended: SamplerConfig) -> SamplerConfig:
        """The model's recommendation with what is said here put over it.

        Asked for another solver than DDIM, it leaves out what is recommended for DDIM alone.
        """
        for name in self.without:
            require_one_of("sampler.without", name, ("compat",))
        said = {name: value for name, value in vars(self).items() if value is not None}
        left_out: dict[str, Any] = dict.fromkeys(said.pop("without"))
        if said.get("solver", "ddim") != "ddim":
            left_out |= {"eta": 0.0, "compat": None}
        return replace(recommended, **(left_out | said))


@dataclass
class ModelConfig:
    """A denoiser with its conditioning (METHOD: paper II-B)."""

    name: str = MISSING
    family: str = "ours"
    """What the denoiser is told: `zeronvs` pose only, `megascenes` pose and the nearest reference's
    warp, `ours` the fused warp, its positional encoding and its mask, too.
    """
    image_size: int = 64
    """Side of the square views that it paints, in pixels."""
    warp_scale: int = 2
    """Side of the warp over `image_size`: made finer and then reduced, thin surfaces survive it."""
    vae: VaeConfig | None = None
    """Autoencoder of the latents; null takes patches of pixels."""
    patch: int = 2
    """Pixels a side that become channels of one latent: the small model's stand-in for a VAE."""
    clip: ClipConfig | None = None
    """Encoder of the reference image; null takes a small one that is trained along."""
    references: int = 3
    """Most references that a view is warped from (paper III-A.4); 1 for the families that are told
    of the nearest alone.
    """
    octaves: int = 4
    """Of the positional encoding: 4 channels each."""
    geometry: bool = False
    """Tell the denoiser the warp's depth and confidence, too; `ours` only: two more input channels,
    which start at zero upon weights without them, the packaged base's among them.
    """
    residual: bool = True
    """Denoise the difference to the hole-filled warp instead of the image itself: to the fused one,
    or for `megascenes` to the nearest reference's. `zeronvs` is told no warp.
    """
    prediction: str = "sample"
    """What the denoiser says: `epsilon` (the noise), `v_prediction` or `sample` (the latent)."""
    zero_terminal_snr: bool = True
    """The noisiest step is pure noise, as sampling starts from (Lin et al. 2023)."""
    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    """How its views are sampled where the command's `sampler` says nothing else; it is saved with
    the weights.
    """
    unet: UNetConfig = field(default_factory=UNetConfig)
    learning_rate: float = 3e-4
    """Of AdamW, after the warm-up."""
    projection_rate: float = 1.0
    """Learning rate of the token's projection, as a multiple of `learning_rate`."""
    weight_decay: float = 0.01
    """Of AdamW."""
    start: str | None = None
    """What training starts from: a model folder, a published checkpoint (ZeroNVS's .ckpt,
    MegaScenes's iter_N folder, a diffusers folder), or `base`, the packaged model; null is random.
    Weights of another family are taken over where they mean the same (`diffusion.transfer`).
    """

    @property
    def warp_size(self) -> int:
        """Side of the references and of the warp between them, in pixels."""
        return self.warp_scale * self.image_size

    @property
    def told_references(self) -> int:
        """`references`, and 1 for the families that are told of no more, whatever it says."""
        return 1 if self.family in NEAREST_ALONE else self.references
