"""A latent-diffusion state dict's tensors under the names of diffusers' and transformers' networks.

diffusers renames denoiser and autoencoder; CLIP's image tower, which it does not know, is ours.
"""

import re
from collections.abc import Callable, Collection, Mapping

from diffusers.loaders.single_file_utils import (
    convert_ldm_unet_checkpoint,
    convert_ldm_vae_checkpoint,
)
from torch import Tensor

from extrap_train.config import ModelConfig

PREFIXES = {
    "unet": "model.diffusion_model.",
    "vae": "first_stage_model.",
    "image_encoder": "cond_stage_model.model.visual.",
    "cc_projection": "cc_projection.",
}
"""What the names of each part begin with."""
_CLIP_ENDS = {
    "vision_model.embeddings.class_embedding": "class_embedding",
    "vision_model.embeddings.patch_embedding.weight": "conv1.weight",
    "vision_model.embeddings.position_embedding.weight": "positional_embedding",
    "vision_model.pre_layrnorm": "ln_pre",
    "vision_model.post_layernorm": "ln_post",
}
_CLIP_LAYER = {
    "self_attn.out_proj": "attn.out_proj",
    "layer_norm1": "ln_1",
    "layer_norm2": "ln_2",
    "mlp.fc1": "mlp.c_fc",
    "mlp.fc2": "mlp.c_proj",
}


def renamed(
    part: str, state: dict[str, Tensor], wanted: Collection[str], config: ModelConfig
) -> Mapping[str, Tensor]:
    """A part's tensors by our names; of CLIP those that are wanted."""
    prefix = PREFIXES[part]
    own = {name: x for name, x in state.items() if name.startswith(prefix)}
    if part == "unet":
        return renamed_unet(own, config.unet.layers_per_block)
    if part == "vae":
        assert config.vae is not None
        return renamed_vae(own, len(config.vae.channels))
    if part == "image_encoder":
        places = {name: clip_origin(name) for name in wanted}
        return {name: make(own[place]) for name, (place, make) in places.items() if place in own}
    return {name.removeprefix(prefix): x for name, x in own.items()}


def renamed_unet(state: dict[str, Tensor], layers_per_block: int) -> dict[str, Tensor]:
    """The denoiser's tensors by diffusers' names."""
    return dict(convert_ldm_unet_checkpoint(state, {"layers_per_block": layers_per_block}))


def renamed_vae(state: dict[str, Tensor], levels: int) -> dict[str, Tensor]:
    """The autoencoder's tensors by diffusers' names."""
    blocks = dict.fromkeys(("down_block_types", "up_block_types"), range(levels))
    return dict(convert_ldm_vae_checkpoint(state, blocks))


def clip_origin(name: str) -> tuple[str, Callable[[Tensor], Tensor]]:
    """The tensor that one of ours is made from, and how.

    Queries, keys and values are stacked in one matrix; the projection is transposed.
    """
    prefix = PREFIXES["image_encoder"]
    if name == "visual_projection.weight":
        return f"{prefix}proj", lambda tensor: tensor.T
    layer = re.fullmatch(r"vision_model\.encoder\.layers\.(\d+)\.(.*)", name)
    if layer is None:
        return prefix + _with_beginning(name, _CLIP_ENDS), lambda tensor: tensor
    block = f"{prefix}transformer.resblocks.{layer[1]}."
    if stacked := re.fullmatch(r"self_attn\.([qkv])_proj\.(weight|bias)", layer[2]):
        third = "qkv".index(stacked[1])
        return f"{block}attn.in_proj_{stacked[2]}", lambda tensor: tensor.chunk(3)[third]
    return block + _with_beginning(layer[2], _CLIP_LAYER), lambda tensor: tensor


def _with_beginning(name: str, beginnings: dict[str, str]) -> str:
    """The name with the beginning that the table knows exchanged; unchanged if it knows none."""
    for ours, theirs in beginnings.items():
        if name == ours or name.startswith(f"{ours}."):
            return theirs + name.removeprefix(ours)
    return name
