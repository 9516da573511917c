"""The published files of weights: {"args": Namespace, "model": state dict}, or safetensors."""

import re
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from extrap_train.config import Mast3rConfig
from extrap_train.depth.mast3r.network.heads import LEVEL_WIDTHS
from extrap_train.depth.mast3r.network.point_map_network import Architecture, PointMapNetwork
from extrap_train.weight_files import WeightFile

HEAD_WIDTH = 64
"""Width of an attention head in every published network; the file does not always say it."""
MAX_BLOCKS = 100
"""Most blocks of an encoder or decoder; the published ones have at most 24."""


def read_network(path: Path, option: str = "depth.checkpoint") -> PointMapNetwork:
    """The network of a MASt3R or DUSt3R file, in evaluation mode; InputError if it is none.

    Its sizes come from the tensors' shapes. The file also holds the Python expression that made the
    network: the numbers of heads are read out of it as text, and it is never evaluated.
    """
    file = WeightFile(path, option, Mast3rConfig.weights)
    content = file.read(inert=["argparse.Namespace"])
    state = _with_both_names(file.tensors(content, "model"))
    expression = ""
    if isinstance(content, Mapping):
        said = getattr(content.get("args"), "model", "")
        expression = said if isinstance(said, str) else ""
    try:
        with torch.device("meta"):
            network = PointMapNetwork(architecture_of(state, expression))
    except (ValueError, ZeroDivisionError) as error:
        raise file.refusal(f"is another network's ({error})") from None
    file.fill(network, state)
    return network.eval().requires_grad_(False)


def architecture_of(state: Mapping[str, Tensor], expression: str = "") -> Architecture:
    """Sizes from a state dict's names and shapes; ValueError if it is of another kind.

    `expression` is the text that may say `enc_num_heads=…` and `dec_num_heads=…`.
    """
    encoder_width, _, patch, _ = _shape(state, "patch_embed.proj.weight", 4)
    decoder_width, _ = _shape(state, "decoder_embed.weight", 2)
    descriptor_width = None
    if "downstream_head1.head_local_features.fc2.bias" in state:
        (out,) = _shape(state, "downstream_head1.head_local_features.fc2.bias", 1)
        descriptor_width = out // patch**2 - 1
    return Architecture(
        encoder_width=encoder_width,
        encoder_depth=_blocks(state, "enc_blocks"),
        encoder_heads=_heads(expression, "enc", encoder_width),
        decoder_width=decoder_width,
        decoder_depth=_blocks(state, "dec_blocks"),
        decoder_heads=_heads(expression, "dec", decoder_width),
        patch=patch,
        head="linear" if "downstream_head1.proj.weight" in state else "dense",
        descriptor_width=descriptor_width,
    )


def _shape(state: Mapping[str, Tensor], name: str, dimensions: int) -> tuple[int, ...]:
    if name not in state or state[name].dim() != dimensions:
        raise ValueError(f"no {name} of {dimensions} dimensions")
    return tuple(state[name].shape)


def _blocks(state: Mapping[str, Tensor], name: str) -> int:
    numbers = {found[1] for key in state if (found := re.match(rf"{name}\.(\d+)\.", key))}
    if len(numbers) > MAX_BLOCKS:
        raise ValueError(f"{len(numbers)} {name}")
    return len(numbers)


def _heads(expression: str, part: str, width: int) -> int:
    said = re.search(rf"\b{part}_num_heads\s*=\s*(\d+)", expression)
    heads = int(said[1]) if said else width // HEAD_WIDTH
    if width % (4 * heads):  # rows and columns, each with pairs that turn
        raise ValueError(f"{width} features do not fall into {heads} heads")
    return heads


def _with_both_names(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Four layers of a dense head have two names each; safetensors keeps one of them."""
    full = dict(state)
    for head in (1, 2):
        for i in range(len(LEVEL_WIDTHS)):
            scratch = f"downstream_head{head}.dpt.scratch"
            names = [f"{scratch}.layer{i + 1}_rn.weight", f"{scratch}.layer_rn.{i}.weight"]
            for name, other in (names, names[::-1]):
                if other in full:
                    full.setdefault(name, full[other])
    return full
