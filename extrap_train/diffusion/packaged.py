"""The small models that come with the package: their names, and the 4-bit format of their files.

All but the base are kept as their difference to it. Of every matrix and kernel that both have in
one shape only `trained − base` is kept, rounded to 15 levels per output channel and deflated; the
rest (biases, norms, layers of another shape) is kept in half precision. Eight models of 20 MB in
half precision each would take 160 MB; so they take 36. docs/small_model.md has what is lost by it.
"""

import json
import zlib
from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from extrap_train.config import MODEL_CONFIG, PACKAGED_MODELS, packaged_names
from extrap_train.errors import InputError

_LEVELS = 7
"""Levels of each sign: −7 … 7 in four bits."""
_CLIPS = torch.linspace(0.35, 1.0, 14)
"""Shares of a channel's largest difference among which its range is chosen."""
_BITS, _SCALE = ":bits", ":scale"


def packaged_weights(name: str, option: str = "model.start") -> Path:
    """Folder of a model that comes with the package; InputError names those that do."""
    if (Path(name) / "model" / MODEL_CONFIG).is_file():
        raise InputError(f"{option}={name}: is a run's folder; give {option}={name}/model")
    if name not in packaged_names():
        raise InputError(
            f"{option}={name} is neither a file or folder of weights nor one of the package's: "
            f"{', '.join(packaged_names())}"
        )
    return PACKAGED_MODELS / name


def packaged_steps(name: str) -> int | None:
    """How many steps a packaged model was trained for; None if that is not recorded."""
    steps: dict[str, int] = json.loads((PACKAGED_MODELS / "steps.json").read_bytes())
    return steps.get(name)


def packaged_name(family: str, category: str) -> str:
    """`ours-hydrant`, for all categories `base`; the published families have one model for all."""
    if family != "ours":
        return family
    return "base" if category == "all" else f"{family}-{category}"


def compress(state: Mapping[str, Tensor], base: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """`state` as differences to `base`, by the same names with a suffix each for bits and scales.

    Tensors that are not kept as a difference stand under their own name.
    """
    tensors: dict[str, Tensor] = {}
    for name, value in state.items():
        if not _is_packed(name, value.shape, base):
            tensors[name] = value.detach().to("cpu", torch.float16).contiguous()
            continue
        difference = value.detach().float().cpu() - base[name].float().cpu()
        packed, tensors[name + _SCALE] = quantised(difference.flatten(1))
        tensors[name + _BITS] = _deflate(packed)
    return tensors


def restore(
    tensors: Mapping[str, Tensor], base: Mapping[str, Tensor], shapes: Mapping[str, torch.Size]
) -> dict[str, Tensor]:
    """What `compress` made its tensors from, as near as four bits come; those called in `shapes`.

    Names that neither hold are left out: whoever loads the result sees what is missing. Raises
    ValueError for bits and scales that do not describe a difference to the base's tensor.
    """
    state = {name: value for name, value in tensors.items() if name in shapes}
    for name in shapes:
        if name + _BITS not in tensors or name not in base:
            continue
        shape = base[name].shape
        if len(shape) < 2:
            raise ValueError(f"{name}: is never kept as a difference")
        packed = _inflate(name, tensors[name + _BITS], shape)
        step = tensors.get(name + _SCALE)
        if step is None or step.shape != shape[:1] or not step.is_floating_point():
            raise ValueError(f"{name}: has no scale a channel")
        difference = dequantised(packed, step, shape[1:].numel())
        state[name] = base[name].float().cpu() + difference.view(shape)
    return state


def quantised(
    rows: Float[Tensor, "o n"],
) -> tuple[UInt8[Tensor, "o m"], Float[Tensor, " o"]]:
    """Two values a byte, the earlier in the lower four bits, and each row's step.

    The step is the one of a few that leaves the least squared error: outliers may be cut off.
    """
    steps = rows.abs().amax(1) / _LEVELS * _CLIPS[:, None].to(rows)  # clips × rows
    steps = steps.half().float()  # as they are stored
    errors = torch.stack([(_round(rows, s) * s[:, None] - rows).square().sum(1) for s in steps])
    step = steps.gather(0, errors.argmin(0)[None])[0]
    codes = (_round(rows, step) + _LEVELS).to(torch.uint8)
    if codes.shape[1] % 2:
        codes = torch.cat([codes, codes.new_zeros(len(codes), 1)], 1)
    return (codes[:, ::2] | codes[:, 1::2] << 4).contiguous(), step.half()


def dequantised(
    packed: UInt8[Tensor, "o m"], step: Float[Tensor, " o"], count: int
) -> Float[Tensor, "o n"]:
    """`count` values a row, of what `quantised` gave."""
    codes = torch.stack([packed & 15, packed >> 4], -1).flatten(1)[:, :count]
    return (codes.float() - _LEVELS) * step.float()[:, None]


def _round(rows: Float[Tensor, "o n"], step: Float[Tensor, " o"]) -> Float[Tensor, "o n"]:
    return (rows / step.clamp_min(1e-12)[:, None]).round().clamp(-_LEVELS, _LEVELS)


def _deflate(packed: UInt8[Tensor, "o m"]) -> UInt8[Tensor, " c"]:
    """Codes near zero are the most frequent: Huffman's code saves a seventh."""
    return torch.frombuffer(
        bytearray(zlib.compress(packed.numpy().tobytes(), 9)), dtype=torch.uint8
    )


def _inflate(name: str, bits: Shaped[Tensor, "..."], shape: torch.Size) -> UInt8[Tensor, "o m"]:
    """Two values a byte for a tensor of this shape; never more memory than that, whatever `bits`
    claims to hold.
    """
    size = shape[0] * -(-shape[1:].numel() // 2)
    if bits.dtype != torch.uint8:
        raise ValueError(f"{name}: its bits are {bits.dtype}, not bytes")
    inflater = zlib.decompressobj()
    try:
        plain = inflater.decompress(bits.numpy().tobytes(), size + 1)
    except zlib.error as error:
        raise ValueError(f"{name}: {error}") from None
    if len(plain) != size or not inflater.eof or inflater.unused_data:
        raise ValueError(f"{name}: its bits are not the {size} bytes that its shape needs")
    return torch.frombuffer(bytearray(plain), dtype=torch.uint8).view(shape[0], -1)


def _is_packed(name: str, shape: torch.Size, base: Mapping[str, Tensor]) -> bool:
    """Vectors are few numbers of much weight: they stay whole."""
    return len(shape) > 1 and name in base and base[name].shape == shape
