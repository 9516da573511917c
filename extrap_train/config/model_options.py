"""The denoiser with its conditioning, and how views are sampled."""

from dataclasses import dataclass, field, replace
from typing import Any

from extrap_train.config.options import MISSING, option, unset

FAMILIES = ("zeronvs", "megascenes", "ours")
"""What a denoiser is conditioned on; `extrap_train.diffusion.family` defines each."""
NEAREST_ALONE = ("zeronvs", "megascenes")
"""Families that are conditioned on the nearest reference alone."""


@dataclass
class UNetConfig:
    """Shape of the denoiser (diffusers' `UNet2DConditionModel`)."""

    channels: list[int] = option(
        [32, 64, 128, 192],
        "width of each level, finest first; multiples of model.unet.norm_groups",
        low=1,
        high=8192,
    )
    layers_per_block: int = option(1, "residual layers per block", low=1, high=16)
    attention_levels: list[bool] = option(
        [False, False, False, True], "levels that attend, finest first"
    )
    heads: int = option(4, "heads of each attention", low=1, high=64)
    token_width: int = option(192, "width of the cross-attention token", low=1, high=8192)
    norm_groups: int = option(16, "groups of the normalisations", low=1, high=1024)


@dataclass
class VaeConfig:
    """Shape of the latent space's autoencoder (diffusers' `AutoencoderKL`); Stable Diffusion's."""

    channels: list[int] = option(
        [128, 256, 512, 512], "width of each level, finest first", low=1, high=8192
    )
    layers_per_block: int = option(2, "residual layers per block", low=1, high=16)


@dataclass
class ClipConfig:
    """Shape of CLIP's image tower at 224² pixels in patches of 14²; ViT-L/14's."""

    width: int = option(1024, "width of the layers", low=1, high=8192)
    layers: int = option(24, "number of layers", low=1, high=64)
    heads: int = option(16, "heads of each attention", low=1, high=64)
    embedding_width: int = option(768, "width of the embedding", low=1, high=8192)


@dataclass
class SamplerConfig:
    """How a view is sampled; the defaults are the small model's."""

    solver: str = option(
        "ddim",
        "sampler: DDIM (paper), or of second order for few steps",
        choices=("ddim", "dpmpp", "unipc"),
    )
    steps: int = option(2, "evaluations of the denoiser", low=1, high=1000)
    eta: float = option(
        0.0,
        "share of DDIM's noise that is drawn again at each step; 0: deterministic",
        low=0,
        high=1,
    )
    guidance: float = option(
        1.0,
        "guidance scale: weight of the conditional against the null prediction; 1: none",
        low=0,
        high=100,
    )
    guidance_rescale: float = option(
        0.0,
        "how far the wider spread from guidance is undone (Lin et al. 2023 use 0.7)",
        low=0,
        high=1,
    )
    compat: str | None = option(
        None,
        "sample as ZeroNVS and MegaScenes were published: guidance against zeros, without the "
        "noisiest step",
        choices=("megascenes",),
    )


@dataclass
class SamplerOptions:
    """Overrides of `SamplerConfig`; null leaves an option at what the model recommends."""

    solver: str | None = unset(SamplerConfig, "solver")
    steps: int | None = unset(SamplerConfig, "steps")
    eta: float | None = unset(SamplerConfig, "eta")
    guidance: float | None = unset(SamplerConfig, "guidance")
    guidance_rescale: float | None = unset(SamplerConfig, "guidance_rescale")
    compat: str | None = unset(SamplerConfig, "compat")

    def over(self, recommended: SamplerConfig) -> SamplerConfig:
        """The model's recommendation, overridden by the options that are set here.

        Asked for another solver than DDIM, it leaves out what is recommended for DDIM alone.
        """
        chosen = {name: value for name, value in vars(self).items() if value is not None}
        is_ddim = chosen.get("solver", "ddim") == "ddim"
        left_out: dict[str, Any] = {} if is_ddim else {"eta": 0.0, "compat": None}
        return replace(recommended, **(left_out | chosen))


@dataclass
class ModelConfig:
    """A denoiser with its conditioning (paper II-B)."""

    name: str = MISSING
    family: str = option(
        "ours",
        "what the denoiser is conditioned on: the pose, also the nearest reference's warp, or the "
        "fused warp with its encoding and mask",
        choices=FAMILIES,
    )
    image_size: int = option(
        64, "side of the square views that are generated", unit="pixels", low=8, high=4096
    )
    warp_scale: int = option(
        2,
        "side of the warp as a multiple of model.image_size; finer warps keep thin surfaces",
        low=1,
        high=8,
    )
    vae: VaeConfig | None = None
    """Autoencoder of the latents; null takes patches of pixels."""
    patch: int = option(
        2,
        "side of the patches that latents are made of without model.vae",
        unit="pixels",
        low=1,
        high=64,
    )
    clip: ClipConfig | None = None
    """Encoder of the reference image; null takes a small one that is trained with the model."""
    references: int = option(
        3,
        "most references that a view is warped from; 1 for zeronvs and megascenes",
        low=1,
        high=16,
    )
    octaves: int = option(4, "octaves of the positional encoding, 4 channels each", low=1, high=16)
    geometry: bool = option(
        False, "condition on the warp's depth and confidence as well; model.family=ours only"
    )
    residual: bool = option(
        True, "denoise the difference to the hole-filled warp instead of the image itself"
    )
    prediction: str = option(
        "sample",
        "what the denoiser predicts: the noise, v, or the clean latent",
        choices=("epsilon", "v_prediction", "sample"),
    )
    zero_terminal_snr: bool = option(
        True, "make the noisiest step pure noise, as sampling starts from (Lin et al. 2023)"
    )
    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    """How its views are sampled where the command's `sampler` says nothing else; it is saved with
    the weights.
    """
    unet: UNetConfig = field(default_factory=UNetConfig)
    learning_rate: float = option(
        3e-4, "learning rate of AdamW after the warm-up", low=1e-9, high=1
    )
    projection_rate: float = option(
        1.0,
        "learning rate of the token's projection, as a multiple of model.learning_rate",
        low=0,
        high=1e6,
    )
    weight_decay: float = option(0.01, "weight decay of AdamW", low=0, high=1)
    start: str | None = option(
        None,
        "weights that training starts from: a model folder, a published checkpoint, a repository "
        "of the Hugging Face hub, or `base`, the packaged model; null: random",
    )

    @property
    def warp_size(self) -> int:
        """Side of the references and of the warp between them, in pixels."""
        return self.warp_scale * self.image_size

    @property
    def num_condition_views(self) -> int:
        """`references`, but 1 for the families of `NEAREST_ALONE`."""
        return 1 if self.family in NEAREST_ALONE else self.references
