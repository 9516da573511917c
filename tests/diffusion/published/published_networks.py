"""A published network with what it was given and what it gave, and our configuration of it."""

from dataclasses import dataclass

import hydra
from omegaconf import OmegaConf
from torch import Tensor

from extrap_train.cli import register_schemas
from extrap_train.config import ClipConfig, ModelConfig, UNetConfig, VaeConfig

FAMILIES = ("zeronvs", "megascenes")
TINY_UNET = UNetConfig(
    channels=[32, 64, 128, 128],
    layers_per_block=2,
    attention_levels=[True, True, True, False],
    heads=8,
    token_width=768,
    norm_groups=32,
)

TINY_MODEL = [
    "model.image_size=128",
    "prep.image_size=256",
    "model.unet.channels=[32,64,128,128]",
    "model.vae.channels=[32,64,128,128]",
    "model.clip.width=128",
    "model.clip.layers=2",
    "model.clip.heads=2",
]
"""The same networks on the command line, for smaller views."""


@dataclass(frozen=True)
class Reference:
    """A published network, what it was given and what it gave."""

    family: str
    state: dict[str, Tensor]
    expected: dict[str, Tensor]


def tiny_config(family: str, **changed: object) -> ModelConfig:
    options: dict[str, object] = {
        "name": "tiny",
        "family": family,
        "image_size": 256,
        "vae": VaeConfig(channels=[32, 64, 128, 128]),
        "clip": ClipConfig(width=128, layers=2, heads=2),
        "residual": False,
        "prediction": "epsilon",
        "zero_terminal_snr": False,
        "unet": TINY_UNET,
    }
    return ModelConfig(**(options | changed))  # type: ignore[arg-type]


def configured(name: str) -> ModelConfig:
    """`model=name` as the command line composes it."""
    register_schemas()
    with hydra.initialize_config_module("conf", version_base="1.3"):
        composed = hydra.compose("train", ["category=hydrant", f"model={name}"])
    typed = OmegaConf.to_object(composed.model)
    assert isinstance(typed, ModelConfig)
    return typed
