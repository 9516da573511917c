"""A trained model as its difference to the one that it started from, in four bits a weight.

Of every matrix and kernel that both have in one shape only `trained − base` is kept, rounded to 15
levels per output channel and deflated; whatever else there is (biases, norms, layers of another
shape) is kept whole, in half precision. docs/small_model.md has what is saved and lost by it.
"""

import zlib
from collections.abc import Mapping

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

_LEVELS = 7
"""Of each sign: −7 … 7 in four bits."""
_CLIPS = torch.linspace(0.35, 1.0, 14)
"""Shares of a channel's largest difference among which its range is chosen."""
_BITS, _SCALE = ":bits", ":scale"


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
        tensors[name + _BITS] = _deflated(packed)
    return tensors


def restore(
    tensors: Mapping[str, Tensor], base: Mapping[str, Tensor], shapes: Mapping[str, torch.Size]
) -> dict[str, Tensor]:
    """What `compress` made its tensors from, as near as four bits come.

    Names that neither hold are left out: whoever loads the result sees what is missing. Raises
    ValueError for damaged bits.
    """
    state = {name: value for name, value in tensors.items() if name in shapes}
    for name, shape in shapes.items():
        if name + _BITS not in tensors or name not in base:
            continue
        packed = _inflated(tensors[name + _BITS], shape[0])
        difference = dequantised(packed, tensors[name + _SCALE], shape[1:].numel())
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
    errors = torch.stack([(_rounded(rows, s) * s[:, None] - rows).square().sum(1) for s in steps])
    step = steps.gather(0, errors.argmin(0)[None])[0]
    codes = (_rounded(rows, step) + _LEVELS).to(torch.uint8)
    if codes.shape[1] % 2:
        codes = torch.cat([codes, codes.new_zeros(len(codes), 1)], 1)
    return (codes[:, ::2] | codes[:, 1::2] << 4).contiguous(), step.half()


def dequantised(
    packed: UInt8[Tensor, "o m"], step: Float[Tensor, " o"], count: int
) -> Float[Tensor, "o n"]:
    """`count` values a row, of what `quantised` gave."""
    codes = torch.stack([packed & 15, packed >> 4], -1).flatten(1)[:, :count]
    return (codes.float() - _LEVELS) * step.float()[:, None]


def _rounded(rows: Float[Tensor, "o n"], step: Float[Tensor, " o"]) -> Float[Tensor, "o n"]:
    return (rows / step.clamp_min(1e-12)[:, None]).round().clamp(-_LEVELS, _LEVELS)


def _deflated(packed: UInt8[Tensor, "o m"]) -> UInt8[Tensor, " c"]:
    """Codes near zero are the most frequent: Huffman's code saves a seventh."""
    return torch.frombuffer(
        bytearray(zlib.compress(packed.numpy().tobytes(), 9)), dtype=torch.uint8
    )


def _inflated(bits: UInt8[Tensor, " c"], rows: int) -> UInt8[Tensor, "o m"]:
    try:
        plain = bytearray(zlib.decompress(bits.numpy().tobytes()))
    except zlib.error as error:
        raise ValueError(str(error)) from None
    return torch.frombuffer(plain, dtype=torch.uint8).view(rows, -1)


def _is_packed(name: str, shape: torch.Size, base: Mapping[str, Tensor]) -> bool:
    """Vectors are few numbers of much weight: they stay whole."""
    return len(shape) > 1 and name in base and base[name].shape == shape
