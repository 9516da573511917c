"""Weights that somebody else trained: read without running any of the file, matched strictly."""

import pickle
import pickletools
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.serialization import safe_globals

from extrap_train.errors import InputError

_DAMAGE = (RuntimeError, OSError, EOFError, ValueError, KeyError, IndexError, AttributeError)
"""What torch raises on files that are cut off or are none of its own."""


class Inert:
    """Stands in for an object of a foreign type that a file holds beside its tensors.

    It keeps the object's plain values as attributes and has no behaviour.
    """

    def __init__(self, *arguments: object, **named: object) -> None:
        self.__dict__.update(named)


@dataclass(frozen=True)
class WeightFile:
    """A file of weights from outside, with what has to be said where it cannot be used."""

    path: Path
    option: str
    """Which option named the file, e.g. `depth.checkpoint`."""
    content: str
    """What it should hold and where that comes from, e.g. `MASt3R's weights (https://…)`."""

    def read(self, inert: Sequence[str] = ()) -> Any:
        """What `torch.save` or safetensors wrote there, on the CPU.

        Nothing but tensors and plain values is made; objects of the types named in `inert`
        (`module.Type`) become `Inert`. Raises InputError where the file is absent, damaged, or
        holds anything else.
        """
        if self.path.is_dir():
            raise self.refusal("is a folder")
        if not self.path.is_file():
            raise self.refusal("there is no such file")
        try:
            if self.path.suffix == ".safetensors":
                return load_file(self.path)
            with safe_globals([(Inert, name) for name in inert]):
                # Mapped: of ten gigabytes only those are read that are used.
                mapped = zipfile.is_zipfile(self.path)
                return torch.load(self.path, map_location="cpu", weights_only=True, mmap=mapped)
        except (pickle.UnpicklingError, TypeError) as error:
            is_unsafe = zipfile.is_zipfile(self.path) or "GLOBAL" in str(error)
            raise self._unreadable(is_unsafe=is_unsafe) from None
        except (*_DAMAGE, SafetensorError):
            raise self._unreadable(is_unsafe=False) from None

    def tensors(self, content: object, *keys: str) -> dict[str, Tensor]:
        """The state dict in what `read` gave: under the first of `keys` that is there, or all."""
        inner = content
        if isinstance(content, Mapping):
            inner = next((content[key] for key in keys if key in content), content)
        if isinstance(inner, Mapping):
            found = {name: x for name, x in inner.items() if isinstance(x, Tensor)}
            if found and len(found) == len(inner):
                return found
        raise self.refusal("holds no table of named tensors")

    def fill(self, network: nn.Module, state: Mapping[str, Tensor]) -> None:
        """Put `state` into `network`, name by name and shape by shape, in the network's precision.

        Parameters on the meta device become those of `state`, without a copy. Raises InputError
        that says how the two differ.
        """
        own = network.state_dict()
        missing, strange = sorted(own.keys() - state.keys()), sorted(state.keys() - own.keys())
        reshaped = [
            f"{name}: {list(state[name].shape)}, not {list(own[name].shape)}"
            for name in own
            if name in state and state[name].shape != own[name].shape
        ]
        differences = [
            f"{len(names)} {kind} ({names[0]})"
            for kind, names in (
                ("missing", missing),
                ("unknown", strange),
                ("of another shape", reshaped),
            )
            if names
        ]
        if differences:
            raise self.refusal(
                f"is another network's: of {len(own)} tensors {', '.join(differences)}"
            )
        on_meta = any(x.is_meta for x in own.values())
        typed = {name: state[name].to(x.dtype) for name, x in own.items()}
        network.load_state_dict(typed, assign=on_meta)

    def refusal(self, reason: str) -> InputError:
        """One line: file, reason, option, and what belongs there."""
        return InputError(f"{self.path}: {reason}; give {self.option}=FILE, {self.content}")

    def _unreadable(self, *, is_unsafe: bool) -> InputError:
        if is_unsafe or _is_pickle_of_objects(self.path):
            return self.refusal("holds more than tensors, which could run code, and is not read")
        return self.refusal("is cut off, damaged, or no file of weights")


def _is_pickle_of_objects(path: Path) -> bool:
    """Whether the file is a whole pickle that names a type or function; nothing of it is run."""
    try:
        with path.open("rb") as file:
            names = {opcode.name for opcode, _, _ in pickletools.genops(file)}
    except (ValueError, OSError, EOFError, UnicodeError):
        return False
    return not names.isdisjoint({"GLOBAL", "STACK_GLOBAL", "INST", "EXT1", "EXT2", "EXT4"})
