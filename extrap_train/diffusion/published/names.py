"""Where a tensor of diffusers' and transformers' networks lies in a latent-diffusion state dict."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from extrap_train.config import ModelConfig

UNET_PREFIX = "model.diffusion_model."
VAE_PREFIX = "first_stage_model."
CLIP_PREFIX = "cond_stage_model.model.visual."
PROJECTION_PREFIX = "cc_projection."

_UNET_RESNET = {
    "norm1": "in_layers.0",
    "conv1": "in_layers.2",
    "time_emb_proj": "emb_layers.1",
    "norm2": "out_layers.0",
    "conv2": "out_layers.3",
    "conv_shortcut": "skip_connection",
}
_UNET_ENDS = {
    "time_embedding.linear_1": "time_embed.0",
    "time_embedding.linear_2": "time_embed.2",
    "conv_in": "input_blocks.0.0",
    "conv_norm_out": "out.0",
    "conv_out": "out.2",
}
_VAE_ATTENTION = {
    "group_norm": "norm",
    "to_q": "q",
    "to_k": "k",
    "to_v": "v",
    "to_out.0": "proj_out",
}
_CLIP_ENDS = {
    "vision_model.embeddings.class_embedding": "class_embedding",
    "vision_model.embeddings.patch_embedding": "conv1",
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


@dataclass(frozen=True)
class Origin:
    """The tensor of a state dict that one of ours is made from, and how."""

    name: str
    made_by: Callable[[Tensor], Tensor] = lambda tensor: tensor


def origin(part: str, name: str, config: ModelConfig) -> Origin:
    """Where tensor `name` of `unet`, `vae`, `image_encoder` or `cc_projection` lies."""
    if part == "unet":
        return Origin(UNET_PREFIX + _unet(name, config))
    if part == "vae":
        assert config.vae is not None
        return _vae(name, len(config.vae.channels))
    if part == "image_encoder":
        return _clip(name)
    return Origin(PROJECTION_PREFIX + name)


def _unet(name: str, config: ModelConfig) -> str:
    """Blocks are numbered through: `layers_per_block` a level and one that resamples."""
    layers, attends = config.unet.layers_per_block, config.unet.attention_levels
    match = re.fullmatch(r"(down|up)_blocks\.(\d+)\.(\w+)\.(\d+)\.(.*)", name)
    if match is None:
        middle = re.fullmatch(r"mid_block\.(\w+)\.(\d+)\.(.*)", name)
        if middle is None:
            return _renamed(name, _UNET_ENDS)
        kind, index, rest = middle.groups()
        place = 1 if kind == "attentions" else 2 * int(index)
        return f"middle_block.{place}.{_unet_inner(kind, rest)}"
    way, level, kind, index, rest = match.groups()
    first = int(level) * (layers + 1)
    if kind == "downsamplers":
        return f"input_blocks.{first + layers + 1}.0.{rest.replace('conv', 'op', 1)}"
    if kind == "upsamplers":
        place = 2 if attends[::-1][int(level)] else 1
        return f"output_blocks.{first + layers}.{place}.{rest}"
    block = f"input_blocks.{first + 1 + int(index)}" if way == "down" else None
    block = block or f"output_blocks.{first + int(index)}"
    return f"{block}.{int(kind == 'attentions')}.{_unet_inner(kind, rest)}"


def _unet_inner(kind: str, rest: str) -> str:
    return _renamed(rest, _UNET_RESNET) if kind == "resnets" else rest


def _vae(name: str, levels: int) -> Origin:
    """Levels of the decoder are counted from the finest; attention is four 1×1 convolutions."""
    attention = re.fullmatch(r"(\w+)\.mid_block\.attentions\.0\.(.*)\.(weight|bias)", name)
    if attention:
        half, rest, kind = attention.groups()
        inner = f"{VAE_PREFIX}{half}.mid.attn_1.{_VAE_ATTENTION[rest]}.{kind}"
        is_matrix = kind == "weight" and rest != "group_norm"
        return Origin(inner, _without_pixels) if is_matrix else Origin(inner)
    name = re.sub(r"mid_block\.resnets\.(\d)", lambda m: f"mid.block_{int(m[1]) + 1}", name)
    name = re.sub(r"down_blocks\.(\d+)", r"down.\1", name)
    name = re.sub(r"up_blocks\.(\d+)", lambda m: f"up.{levels - 1 - int(m[1])}", name)
    for ours, theirs in (
        ("resnets", "block"),
        ("downsamplers.0", "downsample"),
        ("upsamplers.0", "upsample"),
        ("conv_shortcut", "nin_shortcut"),
        ("conv_norm_out", "norm_out"),
    ):
        name = name.replace(ours, theirs)
    return Origin(VAE_PREFIX + name)


def _clip(name: str) -> Origin:
    """Queries, keys and values are stacked in one matrix; the projection is transposed."""
    if name == "visual_projection.weight":
        return Origin(f"{CLIP_PREFIX}proj", lambda tensor: tensor.T)
    layer = re.fullmatch(r"vision_model\.encoder\.layers\.(\d+)\.(.*)", name)
    if layer is None:
        return Origin(CLIP_PREFIX + _renamed(name, _CLIP_ENDS))
    block = f"{CLIP_PREFIX}transformer.resblocks.{layer[1]}."
    stacked = re.fullmatch(r"self_attn\.([qkv])_proj\.(weight|bias)", layer[2])
    if stacked:
        third = "qkv".index(stacked[1])
        return Origin(f"{block}attn.in_proj_{stacked[2]}", lambda tensor: tensor.chunk(3)[third])
    return Origin(block + _renamed(layer[2], _CLIP_LAYER))


def _without_pixels(convolution: Tensor) -> Tensor:
    return convolution.flatten(1)


def _renamed(name: str, beginnings: dict[str, str]) -> str:
    """The name with the beginning that the table knows exchanged; unchanged if it knows none."""
    for ours, theirs in beginnings.items():
        if name == ours or name.startswith(f"{ours}."):
            return theirs + name.removeprefix(ours)
    return name


def origins(part: str, names: Sequence[str], config: ModelConfig) -> dict[str, Origin]:
    """`origin` of many tensors of one part."""
    return {name: origin(part, name, config) for name in names}
