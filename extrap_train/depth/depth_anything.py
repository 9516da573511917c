"""Depth Anything (Yang et al., CVPR and NeurIPS 2024), from transformers, out of a local folder."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from torch import Tensor
from torch.nn import functional
from transformers import AutoConfig, AutoImageProcessor, DepthAnythingForDepthEstimation
from transformers.utils.hub import cached_file

from extrap_train.device import fastest_device
from extrap_train.errors import InputError

_UNUSABLE = (OSError, ValueError, KeyError, TypeError, RuntimeError, SafetensorError)
"""What transformers raises on folders that hold nothing of its own, or something else."""

_HARMLESS: dict[str, Any] = {"local_files_only": True, "trust_remote_code": False}
"""Nothing is downloaded, and code in the folder is neither run nor asked for."""
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
    try:
        kind = AutoConfig.from_pretrained(model, **_HARMLESS).model_type
        if kind != "depth_anything":
            raise _refusal(model, f"is a model of kind {kind}")
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


def _refusal(model: str, reason: str) -> InputError:
    return InputError(
        f"{model}: {reason}; give depth.model=FOLDER with Depth Anything for transformers, such as "
        "a download of huggingface.co/depth-anything/Depth-Anything-V2-Small-hf"
    )
