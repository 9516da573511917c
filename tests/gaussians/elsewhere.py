"""A second device without a GPU: tensors that say they are elsewhere, and refuse what CUDA's do.

Their device is called `meta`, but unlike PyTorch's own they hold numbers: CPU memory that nothing
outside reaches, so that an operation gives the very bits that it gives on the CPU.
"""

from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = "meta"
_aten = torch.ops.aten
_CROSSING = {_aten._to_copy.default, _aten.copy_.default}


class _Elsewhere(Tensor):
    """A tensor of that device; `memory` is where its numbers are."""

    memory: Tensor

    @staticmethod
    def __new__(cls, memory: Tensor) -> "_Elsewhere":
        made = Tensor._make_wrapper_subclass(
            cls, memory.shape, memory.stride(), memory.storage_offset(),
            dtype=memory.dtype, device=torch.device(DEVICE),
        )  # fmt: skip
        made.memory = memory
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    def new_tensor(self, data: Any) -> Tensor:  # type: ignore[override]
        """PyTorch's own leaves the numbers out where the device is called `meta`."""
        return torch.tensor(data, dtype=self.dtype).to(DEVICE)

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        raise AssertionError(f"{func}: outside of `TwoDevices`")


class TwoDevices(TorchDispatchMode):
    """While it is on, tensors may be made on `DEVICE`, moved there and back, and computed with.

    RuntimeError for an operation on tensors of both devices, and for random numbers drawn there:
    a CPU's generator cannot. As with CUDA, a single number may be on the CPU where an operation
    works number by number.
    """

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        given = [each for each in tree_flatten((args, kwargs))[0] if isinstance(each, Tensor)]
        elsewhere = [each for each in given if isinstance(each, _Elsewhere)]
        if elsewhere and func not in _CROSSING:
            _refuse_mixtures(func, given)
        device = kwargs.get("device")
        there = bool(elsewhere) if device is None else torch.device(device).type == DEVICE
        if func is _aten.copy_.default:
            there = isinstance(args[0], _Elsewhere)
        if there and torch.Tag.nondeterministic_seeded in func.tags:
            raise RuntimeError(f"{func}: random numbers are drawn on the CPU, not on {DEVICE}")
        if device is not None:
            kwargs["device"] = "cpu"
        known = {id(each.memory): each for each in elsewhere}  # what is written to in place
        made = func(*tree_map(_memory, args), **tree_map(_memory, kwargs))
        if not there:
            return made
        return tree_map(lambda each: known[id(each)] if id(each) in known else _moved(each), made)


def _memory(value: Any) -> Any:
    return value.memory if isinstance(value, _Elsewhere) else value


def _moved(value: Any) -> Any:
    return _Elsewhere(value) if isinstance(value, Tensor) else value


def _refuse_mixtures(func: Any, given: list[Tensor]) -> None:
    here = [each for each in given if not isinstance(each, _Elsewhere)]
    if torch.Tag.pointwise in func.tags:
        here = [each for each in here if each.dim() > 0]
    if here:
        raise RuntimeError(f"{func}: tensors on the CPU and on {DEVICE}, {list(here[0].shape)}")
