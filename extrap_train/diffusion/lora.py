"""A scene's adapter: low-rank additions to a denoiser's layers, saved apart from its weights."""

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import peft
import torch
from pydantic import Field
from torch import Tensor

from extrap_train.config import LoraConfig
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.errors import InputError
from extrap_train.store.digests import file_digest
from extrap_train.store.records import read_record, write_record
from extrap_train.weight_files import WeightFile, write_tensors

_ATTENTION = ["to_q", "to_k", "to_v", "to_out.0"]
_CONVOLUTIONS = ["conv1", "conv2"]
_WEIGHTS = "adapter_model.safetensors"
_OPTIONS = "adapter_config.json"
_BASE = "base.json"
"""An `AdapterRecord`, next to peft's files."""
_REMEDY = "{} is not an adapter folder of task=scene, or is damaged: make it again"
_MAX_RANK = 1024

_Target = Literal["to_q", "to_k", "to_v", "to_out.0", "conv1", "conv2"]


@dataclass(frozen=True)
class AdapterOrigin:
    """What an adapter was made from."""

    scene: str
    """Its address, the same from any folder."""
    photographs: Mapping[str, str]
    """SHA-256 of the content of the frames that it was trained on, by their names."""
    weights: str
    """Model folder, or a packaged model's name."""


@dataclass(frozen=True)
class AdapterRecord(AdapterOrigin):
    """`base.json` in an adapter's folder."""

    base: str
    """SHA-256 of the weights that the adapter belongs to."""
    tensors: str
    """SHA-256 of the file of the adapter's own tensors."""


@dataclass(frozen=True)
class _SavedOptions:
    """The options of peft that `add_adapter` sets; others name modules to import."""

    peft_type: Literal["LORA"]
    r: Annotated[int, Field(ge=1, le=_MAX_RANK)]
    lora_alpha: Annotated[int, Field(ge=1, le=_MAX_RANK)]
    target_modules: Annotated[list[_Target], Field(min_length=1)]


def add_adapter(model: ExtrapolationModel, options: LoraConfig, seed: int) -> peft.PeftModel:
    """Put a new adapter on the denoiser and let nothing else learn.

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
    """A new adapter on the denoiser for as long as the block lasts, however it ends."""
    adapter = add_adapter(model, options, seed)
    try:
        yield adapter
    finally:
        adapter.unload()


def save_adapter(
    model: ExtrapolationModel, adapter: peft.PeftModel, folder: Path, origin: AdapterOrigin
) -> None:
    """Write a peft adapter folder; `adapter` is what lies on the model's denoiser.

    File by file: that all of it appears at once is for the result that it is part of. Raises
    InputError if the disk is full or closed.
    """
    write_tensors(peft.get_peft_model_state_dict(adapter), folder / _WEIGHTS)
    adapter.peft_config["default"].save_pretrained(str(folder))
    tensors = file_digest(folder / _WEIGHTS)
    write_record(
        folder / _BASE, AdapterRecord(**vars(origin), base=base_hash(model), tensors=tensors)
    )


def adapter_bytes(adapter: peft.PeftModel) -> int:
    """About how much disk the saved adapter takes."""
    weights = peft.get_peft_model_state_dict(adapter).values()
    return sum(x.numel() * x.element_size() for x in weights)


def read_adapter_record(folder: Path) -> AdapterRecord:
    """What a saved adapter was made from and belongs to; InputError if that is damaged."""
    return read_record(folder / _BASE, AdapterRecord, _REMEDY.format(folder))


def load_adapter(model: ExtrapolationModel, folder: Path) -> peft.PeftModel:
    """Put a saved adapter on the denoiser; InputError if it was trained on other weights."""
    remedy = _REMEDY.format(folder)
    record = read_adapter_record(folder)
    options = read_record(folder / _OPTIONS, _SavedOptions, remedy)
    if options.lora_alpha != options.r:  # the tensors were trained at a scale of one
        raise InputError(
            f"{folder / _OPTIONS}: lora_alpha is {options.lora_alpha}, r is {options.r}; {remedy}"
        )
    weights = _read_tensors(folder / _WEIGHTS, record.tensors, remedy)
    if base_hash(model) != record.base:
        raise InputError(
            f"adapter={folder}: was trained on other weights than these; give the weights= it was "
            "made for, or adapt these with task=scene"
        )
    config = peft.LoraConfig(
        r=options.r,
        lora_alpha=options.lora_alpha,
        target_modules=list(options.target_modules),
        inference_mode=True,
    )
    adapter = peft.get_peft_model(model.unet, config)
    own = {name: x.shape for name, x in peft.get_peft_model_state_dict(adapter).items()}
    found = {name: x.shape for name, x in weights.items()}
    if odd := sorted(name for name in own | found if own.get(name) != found.get(name)):
        adapter.unload()
        raise InputError(
            f"adapter={folder}: {len(odd)} tensors do not fit, first {odd[0]}; {remedy}"
        )
    peft.set_peft_model_state_dict(adapter, weights)
    return adapter


def _read_tensors(file: Path, sha256: str, remedy: str) -> dict[str, Tensor]:
    """A safetensors file, which holds nothing but tensors of the size that the file has."""
    weights = WeightFile(file, None, remedy)
    tensors = weights.tensors(weights.read())
    if file_digest(file) != sha256:
        raise InputError(f"{file}: was changed since it was saved; {remedy}")
    return tensors


def base_hash(model: ExtrapolationModel) -> str:
    """SHA-256 of a model's own weights, whether or not an adapter lies on them.

    Also of the networks whose outputs an adapter has learnt to read.
    """
    digest = hashlib.sha256()
    for _, network in sorted(model.parts().items()):
        for name, value in sorted(network.state_dict().items()):
            if ".lora_" not in name:
                digest.update(name.replace(".base_layer", "").encode())
                digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy())
    return digest.hexdigest()
