"""Files of weights: written as everybody may read them, read without running any of what is in
them, and matched strictly.
"""

import pickle
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.serialization import safe_globals

from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_file
from extrap_train.store.digests import file_digest

DAMAGE = (
    RuntimeError,
    OSError,
    EOFError,
    ValueError,
    LookupError,
    AttributeError,
    ArithmeticError,
    AssertionError,
    MemoryError,
    TypeError,
    pickle.UnpicklingError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)
"""What torch and the readers of its archives raise on files that are damaged or not torch's."""
_MAX_PICKLE_BYTES = 16 * 2**20
"""Largest table beside the tensors; that of Stable Diffusion's two thousand has 0.3 MiB."""


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
    option: str | None
    """Which option named the file, e.g. `depth.checkpoint`; None if none did."""
    content: str
    """What it should hold and where that comes from, e.g. `MASt3R's weights (https://…)`. Without
    an option: what to do.
    """

    def read(self, inert: Sequence[str] = ()) -> Any:
        """What `torch.save` or safetensors wrote there, on the CPU.

        Nothing but tensors and plain values is made; objects of the types named in `inert`
        (`module.Type`) become `Inert`. Raises InputError where the file is absent, damaged, or
        holds anything else.
        """
        self._require_readable()
        try:
            if self.path.suffix == ".safetensors":
                return load_file(self.path)
            zipped = self.path.open("rb").read(4) == b"PK\3\4"  # how torch tells the formats apart
            if zipped:
                self._require_uncompressed()
            with safe_globals([(Inert, name) for name in inert]):
                # Mapped: of ten gigabytes only those are read that are used.
                return torch.load(self.path, map_location="cpu", weights_only=True, mmap=zipped)
        except InputError:
            raise
        except (*DAMAGE, SafetensorError):
            raise self.refusal(
                "is cut off, damaged, or no file of weights: what holds more than tensors could "
                "run code, and is not read"
            ) from None

    def require_digest(self, promised: str) -> None:
        """InputError unless the file's SHA-256 begins with these hexadecimal digits."""
        self._require_readable()
        digest = file_digest(self.path)
        if not digest.startswith(promised):
            found = digest[: len(promised)]
            raise self.refusal(
                f"is cut off or another file: its SHA-256 begins with {found}, not {promised}"
            )

    def tensors(self, content: object, *keys: str) -> dict[str, Tensor]:
        """The state dict in what `read` gave: under the first of `keys` that is there, or all."""
        inner = content
        if isinstance(content, Mapping):
            inner = next((content[key] for key in keys if key in content), content)
        if not isinstance(inner, Mapping) or not inner:
            raise self.refusal("holds no table of named tensors")
        for name, x in inner.items():
            if not isinstance(name, str) or not isinstance(x, Tensor):
                raise self.refusal("holds no table of named tensors")
            if x.layout is not torch.strided or x.is_quantized or x.device.type != "cpu":
                raise self.refusal(f"{name} is not a plain tensor")
            if x.numel() * x.element_size() > x.untyped_storage().nbytes():
                raise self.refusal(f"{name} has a shape of more numbers than the file holds")
        return dict(inner)

    def fill(self, network: nn.Module, state: Mapping[str, Tensor]) -> None:
        """Put `state` into `network`, name by name and shape by shape, in the network's precision.

        Parameters on the meta device become those of `state`, without a copy. Raises InputError
        that says how the two differ; integers are not weights.
        """
        own = network.state_dict()
        missing, strange = sorted(own.keys() - state.keys()), sorted(state.keys() - own.keys())
        reshaped = [
            f"{name}: {list(state[name].shape)}, not {list(own[name].shape)}"
            for name in own
            if name in state and state[name].shape != own[name].shape
        ]
        retyped = [
            f"{name}: {state[name].dtype}, not {own[name].dtype}"
            for name in own
            if name in state and _kind(state[name]) != _kind(own[name])
        ]
        differences = [
            f"{len(names)} {kind} ({names[0]})"
            for kind, names in (
                ("missing", missing),
                ("unknown", strange),
                ("of another shape", reshaped),
                ("of another type", retyped),
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
        remedy = f"give {self.option}=FILE, {self.content}" if self.option else self.content
        return InputError(f"{self.path}: {reason}; {remedy}")

    def _require_readable(self) -> None:
        """InputError unless there is a regular file that this user may read: a pipe never ends."""
        try:
            if self.path.is_dir():
                raise self.refusal("is a folder")
            if not self.path.exists():
                raise self.refusal("there is no such file")
            if not self.path.is_file():
                raise self.refusal("is not a regular file")
            self.path.open("rb").close()
        except OSError as error:
            raise self.refusal(f"cannot be opened ({error.strerror})") from None

    def _require_uncompressed(self) -> None:
        """InputError for an archive that torch has not written: it unpacks to more than itself."""
        with zipfile.ZipFile(self.path) as archive:
            entries = archive.infolist()
        if (
            any(entry.compress_type != zipfile.ZIP_STORED for entry in entries)
            or sum(entry.file_size for entry in entries) > self.path.stat().st_size
        ):
            raise self.refusal("is a compressed archive, and weights are never compressed")
        pickled = sum(e.file_size for e in entries if e.filename.endswith(".pkl"))
        if pickled > _MAX_PICKLE_BYTES:
            raise self.refusal(f"holds {pickled >> 20} MiB beside its tensors, far too much")


def write_tensors(
    tensors: Mapping[str, Tensor], path: Path, about: Mapping[str, str] | None = None
) -> None:
    """Write a safetensors file, complete or not at all, with the mode that the umask gives."""
    with atomic_file(path) as temporary:
        try:
            save_file(dict(tensors), temporary, metadata={"format": "pt", **(about or {})})
        except SafetensorError as error:
            raise InputError(
                f"{path}: cannot be written ({error}); free space or choose another folder"
            ) from None


def _kind(x: Tensor) -> tuple[bool, bool]:
    return x.is_floating_point(), x.is_complex()
