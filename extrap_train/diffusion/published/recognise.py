"""What a published checkpoint is: its family and the sizes of its networks, by its tensors."""

import re
from importlib.resources import files
from pathlib import Path

from omegaconf import OmegaConf
from torch import Tensor

from extrap_train.config import ClipConfig, ModelConfig, VaeConfig, validate_model
from extrap_train.diffusion.published.names import PREFIXES, renamed_unet, renamed_vae
from extrap_train.diffusion.published.read import (
    folder_state,
    latent_diffusion_state,
    likely_cause,
)
from extrap_train.errors import InputError
from extrap_train.store.records import read_yaml
from extrap_train.weight_files import DAMAGE, WeightFile

PUBLISHED_CHANNELS = {8: "zeronvs", 11: "megascenes"}
"""Family by the input channels of the denoiser."""
_CLIP_HEAD_WIDTH = 64
State = dict[str, Tensor]


def recognise_config(path: Path, option: str) -> ModelConfig:
    """What the published model in a file or folder, which `weights_at` gave and `option` named, is.

    Family, widths, layers and levels follow from names and shapes alone; nothing but these is read.
    What leaves no trace in them (heads, groups, noise schedule, image size, sampler) is as
    `conf/model/FAMILY.yaml` has it. Raises InputError for tensors that are no such model's.
    """
    if (path / "unet").is_dir():
        file, unet = folder_state(path / "unet", "unet", option)
        _, vae = folder_state(path / "vae", "vae", option)
        _, clip = folder_state(path / "image_encoder", "image_encoder", option)
        cause = "is it the folder of another network?"
    else:
        file, state = latent_diffusion_state(path, option)
        cause = likely_cause(state, "it was cut down, or is another network's")
        try:
            unet, vae, clip = _by_part(state)
        except DAMAGE:  # of names that no such network has
            raise file.refusal(cause) from None
    config = family_config(published_family(file, unet))
    try:
        _set_sizes(config, unet, vae, clip)
    except (LookupError, ValueError, ArithmeticError, StopIteration):
        raise file.refusal(f"its size cannot be recognised: {cause}") from None
    try:
        validate_model(config)
    except InputError as error:
        raise file.refusal(f"is of no size that can be used ({error})") from None
    return config


def input_channels(file: WeightFile, unet: State) -> int:
    """Of a denoiser; InputError for another network's tensors."""
    first = unet.get("conv_in.weight")
    if first is None or first.ndim != 4:
        raise file.refusal("has no convolution conv_in that the denoiser begins with")
    return first.shape[1]


def published_family(file: WeightFile, unet: State) -> str:
    """The family of a published denoiser; InputError for one of another."""
    channels = input_channels(file, unet)
    if channels not in PUBLISHED_CHANNELS:
        raise file.refusal(
            f"its denoiser takes {channels} channels, where ZeroNVS's takes 8 and MegaScenes's 11"
        )
    return PUBLISHED_CHANNELS[channels]


def family_config(family: str) -> ModelConfig:
    """A family at its published size, as `model=FAMILY` composes it."""
    content = read_yaml(Path(str(files("conf"))) / "model" / f"{family}.yaml", "install again")
    content.pop("defaults")
    config = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(ModelConfig), content))
    assert isinstance(config, ModelConfig)
    return config


def _by_part(state: dict[str, Tensor]) -> tuple[State, State, State]:
    """Denoiser and autoencoder by diffusers' names, CLIP's image tower by its own."""
    unet, vae, clip = (
        {name: x for name, x in state.items() if name.startswith(PREFIXES[part])}
        for part in ("unet", "vae", "image_encoder")
    )
    downsamplers = _numbers(unet, r"input_blocks\.(\d+)\.0\.op\.weight$")
    layers = min(downsamplers, default=2) - 1
    levels = len(_numbers(vae, r"encoder\.down\.(\d+)\."))
    tower = {name.removeprefix(PREFIXES["image_encoder"]): x for name, x in clip.items()}
    return renamed_unet(unet, layers), renamed_vae(vae, levels), tower


def _set_sizes(config: ModelConfig, unet: State, vae: State, clip: State) -> None:
    shape = config.unet
    shape.channels, shape.layers_per_block = _levels(unet, "down_blocks")
    attending = _numbers(unet, r"^down_blocks\.(\d+)\.attentions\.")
    shape.attention_levels = [level in attending for level in range(len(shape.channels))]
    shape.token_width = next(x for n, x in unet.items() if n.endswith("attn2.to_k.weight")).shape[1]
    config.vae = VaeConfig(*_levels(vae, "encoder.down_blocks"))
    width = next(x for name, x in clip.items() if name.endswith("class_embedding")).shape[-1]
    projection = next(x for n, x in clip.items() if n in ("proj", "visual_projection.weight"))
    config.clip = ClipConfig(
        width=width,
        layers=len(_numbers(clip, r"(?:resblocks|encoder\.layers)\.(\d+)\.")),
        heads=max(1, width // _CLIP_HEAD_WIDTH),
        embedding_width=projection.numel() // width,
    )


def _levels(state: State, blocks: str) -> tuple[list[int], int]:
    """Width of each level, finest first, and the number of residual layers in the first."""
    levels = _numbers(state, rf"^{re.escape(blocks)}\.(\d+)\.resnets\.")
    widths = [
        state[f"{blocks}.{level}.resnets.0.conv2.weight"].shape[0] for level in sorted(levels)
    ]
    return widths, len(_numbers(state, rf"^{re.escape(blocks)}\.0\.resnets\.(\d+)\."))


def _numbers(state: State, pattern: str) -> set[int]:
    """The different numbers that a pattern finds in the names."""
    return {int(found[1]) for name in state if (found := re.search(pattern, name))}
