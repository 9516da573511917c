"""Depth Anything (Yang et al., CVPR and NeurIPS 2024), from transformers, out of a local folder."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from huggingface_hub.errors import StrictDataclassError
from jaxtyping import Float
from safetensors import SafetensorError
from torch import Tensor
from torch.nn import functional
from transformers import AutoConfig, AutoImageProcessor, DepthAnythingForDepthEstimation
from transformers.utils.hub import cached_file

from extrap_train.device import fastest_device
from extrap_train.errors import InputError
from extrap_train.weight_files import WeightFile

_UNUSABLE = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    RuntimeError,
    SafetensorError,
    StrictDataclassError,
)
"""What transformers raises on folders that hold nothing of its own, or something else."""

_HARMLESS: dict[str, Any] = {"local_files_only": True, "trust_remote_code": False}
"""Nothing is downloaded, and code in the folder is neither run nor asked for."""
_MAX_LAYERS, _MAX_SETTINGS_BYTES = 200, 2**20
_REMEDY = (
    "give depth.model=FOLDER with Depth Anything for transformers, such as a download of "
    "huggingface.co/depth-anything/Depth-Anything-V2-Small-hf"
)
_READ = ("config.json", "preprocessor_config.json", "*.safetensors")


@dataclass(frozen=True)
class DepthAnything:
    """Inverse depth of a single picture, up to scale and shift."""

    network: DepthAnythingForDepthEstimation
    processor: Callable[..., dict[str, Tensor]]
    image_size: int
    """Side, in pixels, of what the network sees."""

    @torch.no_grad()
    def inverse_depth(self, image: Float[Tensor, "3 h w"]) -> Float[Tensor, "h w"]:
        """Greater is nearer; scale and shift mean nothing. On the device of `image`."""
        inputs = self.processor(images=image.cpu(), do_rescale=False, return_tensors="pt")
        pixels = inputs["pixel_values"].to(self.network.device, self.network.dtype)
        found = self.network(pixel_values=pixels).predicted_depth
        if self.network.config.depth_estimation_type == "metric":
            found = 1 / found.clamp_min(1e-6)
        size = (image.shape[1], image.shape[2])
        resized = functional.interpolate(
            found[:, None], size, mode="bilinear", align_corners=False, antialias=True
        )
        return resized[0, 0].to(image)


def read_depth_anything(model: str, device: torch.device | None = None) -> DepthAnything:
    """The model in a folder, or of that name in the cache of downloads; nothing is downloaded.

    Weights are read from safetensors alone. It runs on `device`, by default on the GPU where there
    is one. InputError where it is absent or another model.
    """
    _require_plausible(model)
    try:
        config = AutoConfig.from_pretrained(model, **_HARMLESS)
        if config.model_type != "depth_anything":
            raise _refusal(model, f"is a model of kind {config.model_type}")
        _require_no_larger_than_files(model, config)
        loaded: Any = DepthAnythingForDepthEstimation.from_pretrained(
            model, **_HARMLESS, use_safetensors=True, output_loading_info=True
        )
        processor = AutoImageProcessor.from_pretrained(model, **_HARMLESS)
    except InputError:
        raise
    except _UNUSABLE as error:
        if not Path(model).is_dir() and isinstance(error, OSError):
            raise _refusal(model, "is neither a folder nor in the cache of downloads") from None
        reason = str(error).strip().split("\n")[0] or type(error).__name__
        raise _refusal(model, f"cannot be read ({reason})") from None
    network, said = loaded
    for problem in ("missing_keys", "mismatched_keys", "unexpected_keys"):
        if said.get(problem):
            names = sorted(map(str, said[problem]))
            raise _refusal(model, f"has {len(names)} {problem.replace('_', ' ')} ({names[0]})")
    try:
        side = int(processor.size["height"])
    except (AttributeError, KeyError, TypeError):  # of the shorter side, or no picture at all
        raise _refusal(model, "has no size.height in its preprocessor_config.json") from None
    network = network.eval().requires_grad_(False).to(device or fastest_device())
    return DepthAnything(network, processor, side)


def files_read(model: str) -> list[Path]:
    """What `read_depth_anything` reads, to tell other weights; nothing where there is no model.

    A name in the cache of downloads stands for the revision that its main branch points to.
    """
    try:
        config = cached_file(model, "config.json", local_files_only=True)
    except OSError:
        config = None
    if config is None:
        return []
    folder = Path(config).parent
    return sorted(file for pattern in _READ for file in folder.glob(pattern))


def _require_plausible(model: str) -> None:
    """InputError for sizes that no model has, before memory for them is asked for."""
    for name, largest in (("config.json", 65_536), ("preprocessor_config.json", 4096)):
        for file in (file for file in files_read(model) if file.name == name):
            left: list[tuple[str, Any]] = [("", _settings(model, file))]
            while left:
                key, value = left.pop()
                if isinstance(value, dict):
                    left += value.items()
                elif isinstance(value, list):
                    left += [(key, x) for x in value]
                most = _MAX_LAYERS if key == "num_hidden_layers" else largest
                if isinstance(value, int | float) and not abs(value) <= most:
                    raise _refusal(model, f"says {key}={value} in its {name}, at most {most}")


def _settings(model: str, file: Path) -> dict[str, Any]:
    try:
        if file.stat().st_size > _MAX_SETTINGS_BYTES:
            raise _refusal(model, f"has a {file.name} larger than any settings")
        settings = json.loads(file.read_bytes())
    except OSError as error:
        raise _refusal(model, f"{file.name} cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError):
        raise _refusal(model, f"{file.name} is not valid JSON") from None
    if not isinstance(settings, dict):
        raise _refusal(model, f"{file.name} is not a table of settings")
    return settings


def _require_no_larger_than_files(model: str, config: Any) -> None:
    """InputError if the network has more numbers than the files hold: what they lack would be made
    up in memory, at any size.
    """
    with torch.device("meta"):
        network = DepthAnythingForDepthEstimation(config)
    wanted = sum(x.numel() for x in network.state_dict().values())
    found = 0
    for path in files_read(model):
        if path.suffix == ".safetensors":
            file = WeightFile(path, None, _REMEDY)
            found += sum(x.numel() for x in file.tensors(file.read()).values())
    if wanted > found:
        raise _refusal(model, f"holds {found} numbers, but its config.json is of {wanted}")


def _refusal(model: str, reason: str) -> InputError:
    return InputError(f"{model}: {reason}; {_REMEDY}")
