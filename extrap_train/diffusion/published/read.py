"""Files and folders of published weights, as tensors under our names, complete or refused."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from extrap_train.config import ModelConfig
from extrap_train.diffusion.published.names import PREFIXES, clip_origin, renamed
from extrap_train.weight_files import DAMAGE, WeightFile

SOURCES = (
    "ZeroNVS's .ckpt (https://huggingface.co/kylesargent/ZeroNVS), MegaScenes's iter_N folder "
    "(https://github.com/MegaScenes/nvs) or a diffusers folder"
)
Shapes = Mapping[str, torch.Size]

_LIGHTNING_REMARKS = (
    "pytorch_lightning.callbacks.model_checkpoint.ModelCheckpoint",
    "omegaconf.dictconfig.DictConfig",
    "omegaconf.listconfig.ListConfig",
    "omegaconf.base.ContainerMetadata",
    "omegaconf.base.Metadata",
    "omegaconf.nodes.AnyNode",
    "typing.Any",
)
"""What the Lightning of those years wrote beside the tensors; read as inert remarks."""

_CONTENT = {
    "unet": "the denoiser",
    "vae": "the autoencoder",
    "image_encoder": "CLIP's image tower",
    "cc_projection": "the projection of pose and image",
}
_FOLDER_FILES = {
    "unet": ("diffusion_pytorch_model",),
    "vae": ("diffusion_pytorch_model",),
    "image_encoder": ("model", "pytorch_model"),
    "cc_projection": ("model", "diffusion_pytorch_model", "pytorch_model"),
}
_SUFFIXES = (".safetensors", ".bin")
_LISTED = 5


def read_published(
    path: Path, wanted: Mapping[str, Shapes], config: ModelConfig, option: str
) -> dict[str, tuple[WeightFile, dict[str, Tensor]]]:
    """Each part's tensors under our names, in the file's precision, with the file they are from.

    `path` is one that `weights_at` gave, `option` what named it.
    `wanted` has the tensors of `unet`, `cc_projection`, `vae` and `image_encoder`, each one's
    shape by its name. Raises InputError where the path holds no such weights, or not all of them.
    """
    if (path / "unet").is_dir():
        return {
            part: _folder_part(path / part, part, shapes, option) for part, shapes in wanted.items()
        }
    file, state = latent_diffusion_state(path, option)
    parts = _from_latent_diffusion(file, state, wanted, config)
    return {part: (file, tensors) for part, tensors in parts.items()}


def latent_diffusion_state(path: Path, option: str) -> tuple[WeightFile, dict[str, Tensor]]:
    """The tensors of a published file under its own names."""
    file = WeightFile(path, option, SOURCES)
    state = file.tensors(file.read(_LIGHTNING_REMARKS), "state_dict")
    if all(name.startswith("module.") for name in state):  # saved from inside DDP
        state = {name.removeprefix("module."): x for name, x in state.items()}
    return file, state


def weights_at(path: Path) -> Path | None:
    """The diffusers folder or single file that a user's path leads to; None where there is none.

    MegaScenes's `iter_N` folders hold a single file, named as accelerate's `save_state` names it.
    """
    if path.is_file() or (path / "unet").is_dir():
        return path
    inside = (path / name for name in ("model.safetensors", "pytorch_model.bin"))
    return next((file for file in inside if file.is_file()), None)


def _folder_part(
    folder: Path, part: str, shapes: Shapes, option: str
) -> tuple[WeightFile, dict[str, Tensor]]:
    file, state = folder_state(folder, part, option)
    missing = [name for name in shapes if name not in state]
    if missing:
        raise file.refusal(_listed(missing, len(shapes), "is the folder of another network?"))
    return file, state


def folder_state(folder: Path, part: str, option: str) -> tuple[WeightFile, dict[str, Tensor]]:
    """The tensors of one network's folder, as diffusers or transformers writes it."""
    candidates = [folder / (n + s) for s in _SUFFIXES for n in _FOLDER_FILES[part]]
    found = next((path for path in candidates if path.is_file()), candidates[0])
    file = WeightFile(found, option, SOURCES)
    state = file.tensors(file.read())
    state.pop("vision_model.embeddings.position_ids", None)  # saved by older transformers
    return file, state


def _from_latent_diffusion(
    file: WeightFile, state: dict[str, Tensor], wanted: Mapping[str, Shapes], config: ModelConfig
) -> dict[str, dict[str, Tensor]]:
    for part, names in wanted.items():
        expected = {clip_origin(name)[0] for name in names} if part == "image_encoder" else names
        surplus = sum(name.startswith(PREFIXES[part]) for name in state) - len(expected)
        if surplus > 0:
            raise file.refusal(
                f"holds {surplus} tensors more of {_CONTENT[part]} than this network: it is of "
                "another size than model.unet, model.vae and model.clip say"
            )
    try:
        parts = {part: renamed(part, state, names, config) for part, names in wanted.items()}
    except DAMAGE:  # of names that no such network has
        raise file.refusal(likely_cause(state)) from None
    found = {
        part: {name: parts[part][name] for name in names if name in parts[part]}
        for part, names in wanted.items()
    }
    missing = [f"{part}.{n}" for part in wanted for n in wanted[part] if n not in found[part]]
    if missing:
        total = sum(map(len, wanted.values()))
        raise file.refusal(_listed(missing, total, likely_cause(state)))
    return found


_ANOTHER_SIZE = (
    "it is of another size than model.unet, model.vae and model.clip say, or was cut down"
)


def likely_cause(state: Mapping[str, Tensor], otherwise: str = _ANOTHER_SIZE) -> str:
    """Why tensors are probably missing; `otherwise` where whole networks are there."""
    if any(name.startswith("cond_stage_model.transformer.") for name in state):
        return "it is a text-to-image Stable Diffusion, not a model of this family"
    gone = [
        what
        for part, what in _CONTENT.items()
        if not any(name.startswith(PREFIXES[part]) for name in state)
    ]
    if len(gone) == len(_CONTENT):
        return "its names are not those of a latent-diffusion checkpoint"
    if gone:
        return f"it was exported without {' and '.join(gone)}"
    return otherwise


def _listed(missing: Sequence[str], total: int, cause: str) -> str:
    return f"lacks {len(missing)} of {total} tensors ({_first(missing)}): {cause}"


def _first(names: Sequence[str]) -> str:
    return ", ".join(names[:_LISTED]) + (", …" if len(names) > _LISTED else "")
