"""A trained model on disk: a diffusers folder with safetensors, and back."""

import json
import os
import shutil
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import nn

from extrap_train.config import ModelConfig, UNetConfig
from extrap_train.data.files import write_whole
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.errors import InputError

_PARTS = ("image_encoder", "cc_projection")
_CONFIG = "extrapolation_model.json"


def packaged_weights(name: str) -> Path:
    """Folder of a model that comes with the package; raises InputError naming those that do."""
    folder = Path(__file__).parents[1] / "weights"
    if not (folder / name / _CONFIG).is_file():
        known = sorted(path.parent.name for path in folder.glob(f"*/{_CONFIG}"))
        raise InputError(
            f"model.start={name} is neither a model folder nor one of the package's: "
            f"{', '.join(known)}"
        )
    return folder / name


def save_model(model: ExtrapolationModel, folder: Path, dtype: torch.dtype = torch.float32) -> None:
    """Write `unet/` and `scheduler/` as diffusers does, the other parts as safetensors beside them.

    The folder appears complete or not at all; an older one of that name is replaced.
    """
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        for part, path in _weight_files(temporary).items():
            write_whole(path, _safetensors(getattr(model, part), dtype))
        write_whole(
            temporary / _CONFIG, (json.dumps(asdict(model.config), indent=1) + "\n").encode()
        )
        model.unet.save_config(temporary / "unet")
        model.schedule.save_pretrained(temporary / "scheduler")
        if folder.exists():
            shutil.rmtree(folder)
        temporary.replace(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _weight_files(folder: Path) -> dict[str, Path]:
    files = {part: folder / part / "model.safetensors" for part in _PARTS}
    return files | {"unet": folder / "unet" / "diffusion_pytorch_model.safetensors"}


def _safetensors(module: nn.Module, dtype: torch.dtype) -> bytes:
    """A copy, so that the module that goes on training keeps its precision."""
    tensors = module.state_dict()
    state = {k: v.detach().to("cpu", dtype).contiguous() for k, v in tensors.items()}
    return save(state, metadata={"format": "pt"})


def load_model(folder: Path) -> ExtrapolationModel:
    """The model of a folder written by `save_model`, in float32; strict."""
    try:
        saved = json.loads((folder / _CONFIG).read_text())
        config = ModelConfig(**{**saved, "unet": UNetConfig(**saved["unet"])})
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{folder / _CONFIG}: no model of this project ({error})") from None
    model = ExtrapolationModel(config)
    load_weights(model, folder)
    return model


def load_weights(model: ExtrapolationModel, folder: Path) -> None:
    """Fill a model with a folder's weights; names and shapes must be the same."""
    for part, path in _weight_files(folder).items():
        try:
            getattr(model, part).load_state_dict(load_file(path))
        except (OSError, SafetensorError) as error:
            raise InputError(
                f"{path}: cannot be read ({error}); restore the model folder"
            ) from None
        except RuntimeError as error:
            reason = " ".join(str(error).split())[:300]
            raise InputError(
                f"{path}: does not fit the configured model; give the options it was trained with, "
                f"or model.start=null: {reason}"
            ) from None


def start_weights(model: ExtrapolationModel, start: str | None) -> None:
    """Fill a model with what training starts from: a folder, a packaged model, or nothing."""
    if start is not None:
        folder = Path(start)
        load_weights(model, folder if (folder / _CONFIG).is_file() else packaged_weights(start))
