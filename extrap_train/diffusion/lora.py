"""A scene's adapter: low-rank additions to a denoiser's layers, saved apart from its weights."""

import hashlib
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import peft
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from extrap_train.config import LoraConfig
from extrap_train.diffusion.adapter_card import DENOISER, OTHERS, AdapterOrigin, model_card
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.errors import InputError

_ATTENTION = ["to_q", "to_k", "to_v", "to_out.0"]
_CONVOLUTIONS = ["conv1", "conv2"]
_WEIGHTS = "adapter_model.safetensors"
_OPTIONS = "adapter_config.json"
_BASE = "base.json"
"""Beside peft's files: the weights that the adapter was trained upon, and its `AdapterOrigin`."""
_CARD = "README.md"


def add_adapter(model: ExtrapolationModel, options: LoraConfig, seed: int) -> peft.PeftModel:
    """Put a new adapter upon the denoiser and let nothing else learn.

    It starts without effect. The base weights stay what they are, in memory and on disk;
    `PeftModel.unload` takes the adapter off again.
    """
    targets = _ATTENTION + (_CONVOLUTIONS if options.convolutions else [])
    config = peft.LoraConfig(r=options.rank, lora_alpha=options.rank, target_modules=targets)
    model.requires_grad_(False)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return peft.get_peft_model(model.unet, config)


@contextmanager
def temporary_adapter(
    model: ExtrapolationModel, options: LoraConfig, seed: int
) -> Iterator[peft.PeftModel]:
    """A new adapter upon the denoiser for as long as the block lasts, however it ends."""
    adapter = add_adapter(model, options, seed)
    try:
        yield adapter
    finally:
        adapter.unload()


def save_adapter(
    model: ExtrapolationModel, adapter: peft.PeftModel, folder: Path, origin: AdapterOrigin
) -> None:
    """Write a peft adapter folder; `adapter` is what lies upon the model's denoiser.

    File by file: that all of it appears at once is for the result that it is part of.
    """
    hashes = base_hashes(model)
    adapter.save_pretrained(str(folder))
    (folder / _BASE).write_text(json.dumps(hashes | asdict(origin), indent=1))
    (folder / _CARD).write_text(model_card(origin, hashes))


def saved_base_hashes(folder: Path) -> dict[str, str] | None:
    """`base_hashes` of the weights that a saved adapter is for; None where there is no adapter."""
    try:
        base = json.loads((folder / _BASE).read_text())
        hashes = {key: base[key] for key in (DENOISER, OTHERS)}
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return hashes if (folder / _WEIGHTS).is_file() else None


def saved_origin(folder: Path) -> AdapterOrigin | None:
    """What a saved adapter was made from; None where it does not say, as older ones."""
    try:
        base = json.loads((folder / _BASE).read_text())
        return AdapterOrigin(**{field.name: base[field.name] for field in fields(AdapterOrigin)})
    except (OSError, ValueError, KeyError, TypeError):
        return None


def load_adapter(model: ExtrapolationModel, folder: Path) -> peft.PeftModel:
    """Put a saved adapter upon the denoiser; InputError where it was trained upon other weights.

    Older ones say nothing of other networks than the denoiser.
    """
    try:
        base = json.loads((folder / _BASE).read_text())
        wanted = {DENOISER: base[DENOISER]} | {k: base[k] for k in (OTHERS,) if k in base}
        config = _saved_options(json.loads((folder / _OPTIONS).read_text()))
        weights = load_file(folder / _WEIGHTS)
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        reason = f"{type(error).__name__} {error}".splitlines()[0]
        raise InputError(
            f"adapter={folder}: is no adapter folder of task=scene ({reason}); make it anew"
        ) from None
    own_hashes = base_hashes(model)
    if any(own_hashes[key] != found for key, found in wanted.items()):
        raise InputError(
            f"adapter={folder}: was trained upon other weights than these; give weights= as it was "
            "then, or adapt these with task=scene"
        )
    adapter = peft.get_peft_model(model.unet, config)
    own = {name: x.shape for name, x in peft.get_peft_model_state_dict(adapter).items()}
    found = {name: x.shape for name, x in weights.items()}
    if odd := sorted(name for name in own | found if own.get(name) != found.get(name)):
        adapter.unload()
        raise InputError(f"adapter={folder}: {len(odd)} tensors do not fit, first {odd[0]}")
    peft.set_peft_model_state_dict(adapter, weights)
    return adapter


def _saved_options(saved: dict[str, Any]) -> peft.LoraConfig:
    """Of what `add_adapter` may have set alone: peft's other options name modules to import."""
    targets, rank, alpha = saved["target_modules"], saved["r"], saved["lora_alpha"]
    if saved["peft_type"] != "LORA":
        raise ValueError(f"peft_type is {saved['peft_type']}, not LORA")
    if not set(targets) or not set(targets) <= {*_ATTENTION, *_CONVOLUTIONS}:
        raise ValueError(f"target_modules are {targets}")
    if type(rank) is not int or type(alpha) is not int or rank < 1:
        raise ValueError(f"r is {rank} and lora_alpha {alpha}")
    return peft.LoraConfig(
        r=rank, lora_alpha=alpha, target_modules=list(targets), inference_mode=True
    )


def base_hashes(model: ExtrapolationModel) -> dict[str, str]:
    """SHA-256 of a model's own weights, whether or not an adapter lies upon them.

    Of the denoiser, and of the networks whose outputs an adapter has learnt to read.
    """
    parts = model.parts()
    others = [parts[name] for name in sorted(parts) if name != "unet"]
    return {DENOISER: _hash([parts["unet"]]), OTHERS: _hash(others)}


def _hash(networks: Iterable[nn.Module]) -> str:
    digest = hashlib.sha256()
    for network in networks:
        for name, value in sorted(network.state_dict().items()):
            if ".lora_" not in name:
                digest.update(name.replace(".base_layer", "").encode())
                digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy())
    return digest.hexdigest()
