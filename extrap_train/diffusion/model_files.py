"""A model on disk: a diffusers folder with safetensors, and back; what training starts from."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor

from extrap_train.config import MODEL_CONFIG, ModelConfig, dotted, packaged_names, validate_model
from extrap_train.diffusion.encoders import PixelPatches
from extrap_train.diffusion.hub import weights_folder
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.packaged import compress, packaged_weights, restore
from extrap_train.diffusion.published.config_compat import SCHEDULER, require_same_config
from extrap_train.diffusion.published.read import SOURCES, Shapes, read_published, weights_at
from extrap_train.diffusion.published.recognise import (
    input_channels,
    published_family,
    recognise_config,
)
from extrap_train.diffusion.transfer import narrowed, turned_pose, widened
from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_folder
from extrap_train.store.records import read_record, write_record
from extrap_train.weight_files import WeightFile, write_tensors

_COMPACT = "difference.safetensors"
_REMEDY = "give a model/ folder that task=category wrote"
_DIFFUSERS_NAME = "diffusion_pytorch_model.safetensors"
_FILES = {
    "unet": _DIFFUSERS_NAME,
    "vae": _DIFFUSERS_NAME,
    "image_encoder": "model.safetensors",
    "cc_projection": "model.safetensors",
}


def save_model(model: ExtrapolationModel, folder: Path, dtype: torch.dtype = torch.float32) -> None:
    """Write every part as diffusers or transformers does, and our configuration beside them.

    The folder appears complete or not at all; an older one of that name is replaced.
    """
    with atomic_folder(folder) as temporary:
        write_record(temporary / MODEL_CONFIG, model.config)
        for part, network in model.parts().items():
            (temporary / part).mkdir()
            state = network.state_dict()
            on_cpu = {k: v.detach().to("cpu", dtype).contiguous() for k, v in state.items()}
            write_tensors(on_cpu, temporary / part / _FILES[part])
        model.unet.save_config(temporary / "unet")
        model.schedule.save_pretrained(temporary / "scheduler")
        if model.config.vae is not None:
            model.parts()["vae"].save_config(temporary / "vae")
        if model.config.clip is not None:
            model.parts()["image_encoder"].config.save_pretrained(temporary / "image_encoder")


def save_compact(model: ExtrapolationModel, folder: Path, base: str = "base") -> None:
    """Write the model into a folder as its difference to a packaged one; lossy, for packages."""
    start = packaged_weights(base)
    tensors = compress(_state(model), _state(load_model(start)))
    write_record(folder / MODEL_CONFIG, model.config)
    write_tensors(tensors, folder / _COMPACT, {"base": base, "base_sha256": _digest(start)})


def is_compact(folder: Path) -> bool:
    """Whether the folder is one that `save_compact` wrote."""
    return (folder / _COMPACT).is_file()


def _read_compact(
    folder: Path, wanted: Mapping[str, Shapes], config: ModelConfig, option: str
) -> dict[str, tuple[WeightFile, dict[str, Tensor]]]:
    """Each part's tensors, as `read_published` gives them."""
    file = WeightFile(folder / _COMPACT, option, "a model that task=pack wrote")
    tensors = file.tensors(file.read())
    with safe_open(file.path, framework="pt") as opened:
        about = opened.metadata() or {}
    base = packaged_weights(about.get("base", ""))
    if about.get("base_sha256") != _digest(base):
        raise file.refusal(f"is a difference to another {base.name} than the package holds")
    shapes = {f"{part}.{name}": s for part, inner in wanted.items() for name, s in inner.items()}
    try:
        whole = restore(tensors, _state(load_model(base)), shapes)
    except ValueError as error:
        raise file.refusal(f"is damaged ({error})") from None
    return {
        part: (file, {name: whole[key] for name in inner if (key := f"{part}.{name}") in whole})
        for part, inner in wanted.items()
    }


def _state(model: ExtrapolationModel) -> dict[str, Tensor]:
    return {
        f"{part}.{name}": x
        for part, network in model.parts().items()
        for name, x in network.state_dict().items()
    }


def _digest(folder: Path) -> str:
    """SHA-256 of all weights in a model's folder."""
    files = sorted(folder.rglob("*.safetensors"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def load_model(folder: Path, option: str = "weights") -> ExtrapolationModel:
    """The model of a folder written by `save_model` that `option` named, in float32; strict."""
    config = saved_config(folder)
    with torch.device("meta"):
        model = ExtrapolationModel(config)
    load_weights(model, folder, option)
    return model


def is_own(path: Path) -> bool:
    """Whether the path is a folder that says itself which model it holds."""
    return (path / MODEL_CONFIG).is_file()


def saved_config(folder: Path) -> ModelConfig:
    """What the model of a folder is: of the types and within the bounds that the command line's
    options have, too; InputError otherwise.
    """
    file = folder / MODEL_CONFIG
    config = read_record(file, ModelConfig, _REMEDY)
    said = json.loads(file.read_bytes())
    if unknown := sorted(dotted(said).keys() - dotted(asdict(config)).keys()):
        raise InputError(f"{file}: no model of this project (unknown: {unknown[0]}); {_REMEDY}")
    try:
        validate_model(config)
    except InputError as error:
        raise InputError(f"{file}: no model of this project ({error}); {_REMEDY}") from None
    return config


def load_weights(
    model: ExtrapolationModel, path: Path, option: str = "model.start", *, to_train: bool = True
) -> None:
    """Fill a model with the weights of a folder or of a published checkpoint that `option` named.

    Names and shapes must be the same, but where one family starts from another (`transfer`): its
    new channels then say nothing yet, so that only what is `to_train` may.
    """
    networks = model.parts()
    if is_own(path):
        _require_same_start(path, model.config)
    else:
        require_same_config(path, {**networks, SCHEDULER: model.schedule}, to_train=to_train)
    wanted = {
        part: {name: x.shape for name, x in network.state_dict().items()}
        for part, network in networks.items()
    }
    read = _read_compact if is_compact(path) else read_published
    found = read(path, wanted, model.config, option)
    file, unet = found["unet"]
    channels = input_channels(file, unet)
    family = saved_config(path).family if is_own(path) else published_family(file, unet)
    if family != model.config.family:
        if not to_train:
            raise file.refusal(_untrained(family, channels, model.config))
        _take_over(found, family, model)
    elif model.config.geometry and _lacks_geometry(path, model.config):
        unet["conv_in.weight"] = widened(unet["conv_in.weight"], model.unet.conv_in.in_channels)
    for part, (part_file, tensors) in found.items():
        part_file.fill(networks[part], tensors)


def _require_same_start(path: Path, config: ModelConfig) -> None:
    """InputError where the same tensors would mean something else than they do in a saved model."""
    saved = saved_config(path)
    keys: tuple[str, ...] = ("prediction", "unet.heads", "unet.norm_groups", "clip.heads")
    if saved.family == config.family:
        keys += ("residual",)
    before, now = dotted(asdict(saved)), dotted(asdict(config))
    for key in keys:
        if before.get(key) != now.get(key):
            raise InputError(
                f"{path / MODEL_CONFIG}: was trained with {key}={before.get(key)}, and its weights "
                f"mean nothing with model.{key}={now.get(key)}: give it that value, or "
                "model.start=null"
            )


def _lacks_geometry(path: Path, config: ModelConfig) -> bool:
    """Whether all that a saved model's denoiser is not told is the warp's depth and confidence;
    published ones never were.
    """
    saved = saved_config(path) if is_own(path) else None
    return saved is not None and not saved.geometry and saved.octaves == config.octaves


def _untrained(family: str, channels: int, config: ModelConfig) -> str:
    said = (
        f"is of the family {family} ({channels} input channels), but model={config.name} "
        f"is of {config.family} and was never trained: give model={family}"
    )
    is_a_start = family == "zeronvs"  # of a VAE's latents, none is narrowed
    return said + (", or train from it (task=category model.start=FILE)" if is_a_start else "")


def _take_over(
    found: dict[str, tuple[WeightFile, dict[str, Tensor]]], family: str, model: ExtrapolationModel
) -> None:
    """Fit the tensors of a denoiser of `family` to the model's own, in place."""
    (file, unet), (_, projection) = found["unet"], found["cc_projection"]
    weight, own = unet["conv_in.weight"], model.config.family
    channels = model.unet.conv_in.weight.shape[1]
    grows = weight.shape[1] <= channels
    if family == "ours" and isinstance(model.autoencoder, PixelPatches):
        unet["conv_in.weight"] = narrowed(weight, model.autoencoder, own)
    elif family == "zeronvs" and grows:
        unet["conv_in.weight"] = widened(weight, channels)
    else:
        raise file.refusal(
            f"is of the family {family} ({weight.shape[1]} input channels), but model.family={own} "
            f"takes {channels}: only zeronvs can be widened to another, and only a small `ours` "
            f"narrowed; choose model.family={family}"
        )
    if own == "megascenes":
        turned = turned_pose(projection["weight"], projection["bias"])
        projection["weight"], projection["bias"] = turned


def initial_model(config: ModelConfig) -> ExtrapolationModel:
    """What training starts with: `config.start`'s weights, or random ones at the small size.

    `config.start` is a folder, a published checkpoint, or a name that `weights_folder` knows.
    """
    if config.start is None:
        if config.vae is not None or config.clip is not None:
            raise InputError(
                f"model={config.name} is made of pretrained networks: give model.start=PATH, "
                f"{SOURCES}"
            )
        return ExtrapolationModel(config)
    return _fill(config.start, config, "model.start", to_train=True)


def published_model(weights: str, config: ModelConfig | None = None) -> ExtrapolationModel:
    """A published checkpoint's model, to be used as it is: the one that `config` describes, by
    default the one that its tensors show.

    Raises InputError for weights of another family: they are a start, and no model.
    """
    config = published_config(weights) if config is None else config
    return _fill(weights, config, "weights", to_train=False)


def published_config(weights: str, option: str = "weights") -> ModelConfig:
    """What the published checkpoint that `option` named is, by its tensors."""
    return recognise_config(_place(weights, option), option)


def _fill(weights: str, config: ModelConfig, option: str, *, to_train: bool) -> ExtrapolationModel:
    with torch.device("meta"):
        model = ExtrapolationModel(config)
    load_weights(model, _place(weights, option), option, to_train=to_train)
    return model


def _place(weights: str, option: str) -> Path:
    """The file or folder that holds the weights of this name."""
    given = packaged_weights(weights) if weights in packaged_names() else Path(weights)
    path = given if is_compact(given) else weights_at(given)
    return weights_folder(weights, option) if path is None else path
