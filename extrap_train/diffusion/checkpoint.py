"""A model on disk: a diffusers folder with safetensors, and back; what training starts from."""

import json
import os
import shutil
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor, nn

from extrap_train.config import ClipConfig, ModelConfig, UNetConfig, VaeConfig
from extrap_train.data.files import write_whole
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.published.read import SOURCES, read_published, weights_at
from extrap_train.errors import InputError
from extrap_train.weight_files import WeightFile

_CONFIG = "extrapolation_model.json"
_PUBLISHED_CHANNELS = {8: "zeronvs", 11: "megascenes"}
_DIFFUSERS_NAME = "diffusion_pytorch_model.safetensors"
_FILES = {
    "unet": _DIFFUSERS_NAME,
    "vae": _DIFFUSERS_NAME,
    "image_encoder": "model.safetensors",
    "cc_projection": "model.safetensors",
}


def packaged_weights(name: str) -> Path:
    """Folder of a model that comes with the package; raises InputError naming those that do."""
    folder = Path(__file__).parents[1] / "weights"
    if not (folder / name / _CONFIG).is_file():
        known = sorted(path.parent.name for path in folder.glob(f"*/{_CONFIG}"))
        raise InputError(
            f"model.start={name} is neither a file or folder of weights nor one of the package's: "
            f"{', '.join(known)}"
        )
    return folder / name


def save_model(model: ExtrapolationModel, folder: Path, dtype: torch.dtype = torch.float32) -> None:
    """Write every part as diffusers or transformers does, and our configuration beside them.

    The folder appears complete or not at all; an older one of that name is replaced.
    """
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        write_whole(
            temporary / _CONFIG, (json.dumps(asdict(model.config), indent=1) + "\n").encode()
        )
        for part, network in model.parts().items():
            (temporary / part).mkdir()
            _write_weights(network, temporary / part / _FILES[part], dtype)
        model.unet.save_config(temporary / "unet")
        model.schedule.save_pretrained(temporary / "scheduler")
        if model.config.vae is not None:
            model.parts()["vae"].save_config(temporary / "vae")
        if model.config.clip is not None:
            model.parts()["image_encoder"].config.save_pretrained(temporary / "image_encoder")
        if folder.exists():
            shutil.rmtree(folder)
        temporary.replace(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write_weights(network: nn.Module, path: Path, dtype: torch.dtype) -> None:
    """A copy, so that the module that goes on training keeps its precision."""
    tensors = network.state_dict()
    state = {k: v.detach().to("cpu", dtype).contiguous() for k, v in tensors.items()}
    try:
        save_file(state, path, metadata={"format": "pt"})
    except (OSError, SafetensorError) as error:
        raise InputError(
            f"{path}: cannot be written ({error}); free space or choose another folder"
        ) from None


def load_model(folder: Path) -> ExtrapolationModel:
    """The model of a folder written by `save_model`, in float32; strict."""
    config = _saved_config(folder)
    with torch.device("meta"):
        model = ExtrapolationModel(config)
    load_weights(model, folder)
    return model


def _saved_config(folder: Path) -> ModelConfig:
    inner = {"unet": UNetConfig, "vae": VaeConfig, "clip": ClipConfig}
    try:
        saved = json.loads((folder / _CONFIG).read_text())
        for name, kind in inner.items():
            if saved.get(name) is not None:
                saved[name] = kind(**saved[name])
        return ModelConfig(**saved)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{folder / _CONFIG}: no model of this project ({error})") from None


def load_weights(model: ExtrapolationModel, path: Path) -> None:
    """Fill a model with the weights of a folder or of a published checkpoint.

    Names and shapes must be the same, but for a denoiser of the `zeronvs` family that another
    family starts from: its new input channels start at zero, which leaves its output as it was.
    """
    networks = model.parts()
    wanted = {
        part: {name: x.shape for name, x in network.state_dict().items()}
        for part, network in networks.items()
    }
    found = read_published(path, wanted, model.config)
    file, unet = found["unet"]
    family = _family(path, file, unet["conv_in.weight"])
    unet["conv_in.weight"] = _widened(file, unet["conv_in.weight"], family, model)
    for part, (part_file, tensors) in found.items():
        part_file.fill(networks[part], tensors)


def _family(path: Path, file: WeightFile, conv_in: Tensor) -> str:
    if (path / _CONFIG).is_file():
        return _saved_config(path).family
    channels = conv_in.shape[1]
    if channels not in _PUBLISHED_CHANNELS:
        raise file.refusal(
            f"its denoiser takes {channels} channels, where ZeroNVS's takes 8 and MegaScenes's 11"
        )
    return _PUBLISHED_CHANNELS[channels]


def _widened(file: WeightFile, weight: Tensor, family: str, model: ExtrapolationModel) -> Tensor:
    """First layer with zeros for the channels that the published denoiser was not told."""
    wanted = model.unet.conv_in.weight.shape
    if family == model.config.family:
        return weight
    if family != "zeronvs" or weight.shape[1] > wanted[1]:
        raise file.refusal(
            f"is of the family {family} ({weight.shape[1]} input channels), but model.family="
            f"{model.config.family} takes {wanted[1]}: only zeronvs can be widened to another; "
            f"choose model.family={family}"
        )
    zeros = weight.new_zeros(len(weight), wanted[1] - weight.shape[1], *weight.shape[2:])
    return torch.cat([weight, zeros], 1)


def initial_model(config: ModelConfig) -> ExtrapolationModel:
    """What training starts with: `config.start`'s weights, or random ones at the small size.

    `config.start` is a folder, a published checkpoint or the name of a packaged model.
    """
    if config.start is None:
        if config.vae is not None or config.clip is not None:
            raise InputError(
                f"model={config.name} is made of pretrained networks: give model.start=PATH, "
                f"{SOURCES}"
            )
        return ExtrapolationModel(config)
    with torch.device("meta"):
        model = ExtrapolationModel(config)
    path = weights_at(Path(config.start))
    load_weights(model, packaged_weights(config.start) if path is None else path)
    return model
