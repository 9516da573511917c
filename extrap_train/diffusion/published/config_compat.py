"""What the same tensors may mean otherwise: read from the JSON files of a diffusers folder.

Heads, normalisation groups, activations, the latents' scale and what the denoiser predicts leave no
trace in a tensor's name or shape.
"""

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from transformers import CLIPVisionConfig

from extrap_train.data.json_files import read_json, require_dict
from extrap_train.errors import InputError

SCHEDULER = "scheduler"
_FILES = {
    "unet": "config.json",
    "vae": "config.json",
    "image_encoder": "config.json",
    SCHEDULER: "scheduler_config.json",
}
_KEYS: dict[str, dict[str, str]] = {
    "unet": {
        "attention_head_dim": "model.unet.heads",
        "norm_num_groups": "model.unet.norm_groups",
        "norm_eps": "",
        "act_fn": "",
        "flip_sin_to_cos": "",
        "freq_shift": "",
        "center_input_sample": "",
        "downsample_padding": "",
        "mid_block_scale_factor": "",
        "resnet_out_scale_factor": "",
        "time_embedding_type": "",
    },
    "vae": {
        "scaling_factor": "",
        "shift_factor": "",
        "latents_mean": "",
        "latents_std": "",
        "norm_num_groups": "",
        "act_fn": "",
    },
    "image_encoder": {
        "num_attention_heads": "model.clip.heads",
        "hidden_act": "",
        "layer_norm_eps": "",
    },
    SCHEDULER: {
        "prediction_type": "model.prediction",
        "rescale_betas_zero_snr": "model.zero_terminal_snr",
        "num_train_timesteps": "",
        "beta_start": "",
        "beta_end": "",
        "beta_schedule": "",
        "trained_betas": "",
    },
}
"""What is compared, with the option that sets it, where one does."""


_MAX_BYTES = 2**20


def require_same_config(folder: Path, networks: Mapping[str, Any], *, to_train: bool) -> None:
    """InputError for the first key of a diffusers folder that the networks have another value of.

    `networks` are the model's by the names of their folders, its scheduler among them. A part
    without a JSON file says nothing. The noise of the last step may be another in what is
    `to_train`: models are trained on to zero terminal SNR (Lin et al. 2023).
    """
    for part, keys in _KEYS.items():
        path, network = folder / part / _FILES[part], networks.get(part)
        if not hasattr(network, "config") or not path.is_file():
            continue
        said, own = _read(path), _known(network)
        for key, option in keys.items():
            if to_train and key == "rescale_betas_zero_snr":
                continue
            found = _value(said, key, _default(network, key))
            if found != (wanted := _value(own, key, None)):
                remedy = f"give {option}={found}" if option else "no option changes that"
                raise InputError(
                    f"{path}: {key}={found}, but the model that is asked for has {wanted}: "
                    f"{remedy}, or other weights"
                )


def _read(path: Path) -> dict[str, Any]:
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f"{path}: is larger than any table of settings; download it again")
    said = require_dict(read_json(path), "a table of settings, as in a diffusers folder", path)
    inner = said.get("vision_config")  # of a whole CLIP
    return inner if isinstance(inner, dict) else said


def _known(network: Any) -> dict[str, Any]:
    config = network.config
    return config.to_dict() if isinstance(config, CLIPVisionConfig) else dict(config)


def _default(network: Any, key: str) -> Any:
    """What a file means that does not say it."""
    if isinstance(network.config, CLIPVisionConfig):
        return CLIPVisionConfig().to_dict()[key]
    return inspect.signature(type(network).__init__).parameters[key].default


def _value(said: Mapping[str, Any], key: str, default: Any) -> Any:
    """One number for one a level where all are the same; heads by the later of their two names."""
    value = said.get(key, default)
    if key == "attention_head_dim":
        value = said.get("num_attention_heads") or value
    is_repeated = isinstance(value, list | tuple) and len(set(map(str, value))) == 1
    return value[0] if is_repeated else value
