"""The small network of the parity fixture, and the file that it would be downloaded as."""

import argparse
import json
import runpy
import zlib
from pathlib import Path

import torch
from torch import Tensor

from extrap_train.depth.mast3r.network.point_map_network import Architecture, PointMapNetwork

TINY = Architecture(
    encoder_width=64,
    encoder_depth=3,
    encoder_heads=2,
    decoder_width=48,
    decoder_depth=12,
    decoder_heads=3,
)
EXPRESSION = (
    "AsymmetricMASt3R(pos_embed='RoPE100', img_size=(128, 128), depth_mode=('exp', -inf, inf), "
    "enc_embed_dim=64, enc_depth=3, enc_num_heads=2, dec_embed_dim=48, dec_depth=12, "
    "dec_num_heads=3, two_confs=True, landscape_only=__import__('os').abort())"
)
"""As published files say it; whoever evaluates this one ends the process."""


def tiny_state(shared: Path) -> dict[str, Tensor]:
    """The fixture's seeded weights, with equal values under the two names of a layer."""
    layout = json.loads((shared / "fixtures" / "mast3r_tiny" / "layout.json").read_text())
    state = runpy.run_path(str(shared / "fixtures" / "seeded.py"))["weights"](layout["keys"])
    for name in list(state):
        head, found, rest = name.partition(".layer_rn.")
        if found:
            level, _, last = rest.partition(".")
            state[f"{head}.layer{int(level) + 1}_rn.{last}"] = state[name]
    return state


def write_checkpoint(state: dict[str, Tensor], path: Path, expression: str = EXPRESSION) -> Path:
    torch.save({"args": argparse.Namespace(model=expression), "model": state}, path)
    return path


def plain_state(architecture: Architecture) -> dict[str, Tensor]:
    """Weights that tell tensors apart but are made in no time; alike where two names are one."""
    with torch.device("meta"):
        state = PointMapNetwork(architecture).state_dict(keep_vars=True)
    first_name: dict[int, str] = {}
    return {
        name: torch.full(x.shape, zlib.crc32(first_name.setdefault(id(x), name).encode()) / 2**32)
        for name, x in state.items()
    }
