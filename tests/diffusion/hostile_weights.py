"""Hostile and damaged files of weights and of their settings."""

import io
import json
import os
import pickle
import random
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save as save_safetensors
from torch import nn

_SEED = 20
Case = tuple[str, bytes]


class Bomb:
    """Makes a file when it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (f"touch {self.target}",)


def _torch_saved(content: object, *, zipped: bool = True) -> bytes:
    buffer = io.BytesIO()
    torch.save(content, buffer, _use_new_zipfile_serialization=zipped)
    return buffer.getvalue()


def _archive(entries: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def hostile_pickles(target: Path) -> Iterator[Case]:
    """Every way to name a function in a pickle, and to ask for memory, bare and within torch's
    archive.
    """
    command = f"touch {target}".encode()
    word = b"\x8c" + bytes([len(command)]) + command
    calls = {
        "GLOBAL REDUCE": b"\x80\x02cos\nsystem\n" + b"X" + struct.pack("<I", len(command)) + command
        + b"\x85R.",
        "STACK_GLOBAL REDUCE": b"\x80\x04\x8c\x02os\x8c\x06system\x93" + word + b"\x85R.",
        "INST": b"(S'" + command + b"'\nios\nsystem\n.",
        "OBJ": b"(cos\nsystem\nS'" + command + b"'\no.",
        "NEWOBJ": b"\x80\x02csubprocess\nPopen\n(S'" + command + b"'\nt\x81.",
        "BUILD": b"\x80\x02ctypes\nSimpleNamespace\n)R}S'a'\ncos\nsystem\nsb.",
        "EXT1": b"\x80\x02\x82\x01.",
        "builtins eval": b"\x80\x02cbuiltins\neval\n" + word + b"\x85R.",
        "torch hub": b"\x80\x02ctorch.hub\nload\n" + word + b"\x85R.",
        "bytearray": b"\x80\x02cbuiltins\nbytearray\n\x8a\x06" + (10**12).to_bytes(6, "little")
        + b"\x85R.",
        "Tensor": b"\x80\x02ctorch\nTensor\n\x8a\x06" + (10**12).to_bytes(6, "little") + b"\x85R.",
        "long text": b"\x80\x04\x8d" + struct.pack("<Q", 3 * 2**30) + b"a.",
        "longer text": b"\x80\x04\x8d" + struct.pack("<Q", 2**50) + b"a.",
        "long number": b"\x80\x02\x8b" + struct.pack("<i", 2**31 - 1) + b"a.",
        "deep list": b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b".",
        "deep tuple": b"\x80\x02)" + b"\x85" * 100_000 + b".",
        "marks": b"\x80\x02" + b"(" * 1_000_000 + b".",
        "memo": b"\x80\x02]r" + struct.pack("<I", 2**32 - 1) + b".",
        "empty stack": b"\x80\x02R.",
        "bad persistent id": b"\x80\x02K\x01Q.",
        "unknown opcode": b"\x80\x02\xff.",
        "protocol 99": b"\x80\x63N.",
    }  # fmt: skip
    for name, content in calls.items():
        yield name, content
        version = {"archive/version": b"3\n", "archive/byteorder": b"little"}
        yield f"{name} in an archive", _archive({"archive/data.pkl": content, **version})


def _saved_by_torch(state: dict[str, torch.Tensor], target: Path) -> Iterator[Case]:
    first = next(iter(state))
    odd = {
        "expanded": torch.zeros(1).expand(10**6, 10**6),
        "sparse": torch.zeros(4, 4).to_sparse(),
        "complex": state[first].to(torch.complex64),
        "integers": state[first].to(torch.int64),
        "quantised": torch.quantize_per_tensor(torch.zeros(2, 2), 0.1, 0, torch.quint8),
        "no elements": torch.zeros(0, 10**6),
        "meta": torch.zeros(2, device="meta"),
        "a list": [1, 2],
        "a bomb": Bomb(target),
    }
    for name, value in odd.items():
        for zipped in (True, False):
            if zipped or name != "meta":
                content = _torch_saved({**state, first: value}, zipped=zipped)
                yield f"{name}, {'zip' if zipped else 'legacy'}", content
    yield "a bomb beside", _torch_saved({"state_dict": state, "hyper": Bomb(target)})
    yield "a pickle of a bomb", pickle.dumps({"model": Bomb(target)})
    whole = _torch_saved(state)
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    yield "compressed", _archive(entries, zipfile.ZIP_DEFLATED)
    bomb = {**entries, next(n for n in entries if n.endswith("data.pkl")): bytes(10**9)}
    yield "zip bomb", _archive(bomb, zipfile.ZIP_DEFLATED)
    yield "zip of a pickle", _archive({"net.pth": _torch_saved({"a": Bomb(target)}, zipped=False)})
    scripted = io.BytesIO()
    torch.jit.save(torch.jit.script(nn.Linear(2, 2)), scripted)
    yield "TorchScript", scripted.getvalue()
    yield from damaged("torch", whole)


def hostile_safetensors(state: dict[str, torch.Tensor]) -> Iterator[Case]:
    def headed(header: Any, length: int | None = None, body: bytes = bytes(64)) -> bytes:
        text = header if isinstance(header, bytes) else json.dumps(header).encode()
        return struct.pack("<Q", len(text) if length is None else length) + text + body

    def one(**changed: Any) -> dict[str, Any]:
        return {"a": {"dtype": "F32", "shape": [4, 4], "data_offsets": [0, 64], **changed}}

    yield "negative shape", headed(one(shape=[-4, -4]))
    yield "shape of 2**70", headed(one(shape=[2**35, 2**35]))
    yield "shape without elements", headed(one(shape=[0, 2**60], data_offsets=[0, 0]), body=b"")
    yield "shape of text", headed(one(shape=["4", "4"]))
    yield "offsets behind the end", headed(one(data_offsets=[0, 2**40]))
    yield "offsets backwards", headed(one(data_offsets=[64, 0]))
    yield "offsets overlapping", headed(one() | {"b": one()["a"]})
    yield "a hole", headed(one() | {"b": one(data_offsets=[128, 192])["a"]}, body=bytes(192))
    for dtype in ("F128", "BOOL", "F8_E4M3", "C64", "F4", "U64", 3, None):
        yield f"dtype {dtype}", headed(one(dtype=dtype))
    yield "deep header", headed(b'{"a":' * 200_000 + b"1" + b"}" * 200_000)
    yield "header of 2**63", headed(one(), length=2**63)
    yield "header of 3 GiB", headed(one(), length=3 * 2**30)
    yield "header of a list", headed([1])
    yield "header of other bytes", headed(b"\xff\xfe" * 50)
    yield "no header", b""
    yield "metadata of numbers", headed({"__metadata__": {"a": 1}, **one()})
    yield "many names", headed({str(i): one()["a"] for i in range(50_000)})
    yield "valid, of no network", save_safetensors({"a": torch.zeros(4)})
    yield from damaged("safetensors", save_safetensors(state))


def damaged(name: str, whole: bytes) -> Iterator[Case]:
    drawn = random.Random(_SEED)
    for _ in range(5):
        at = drawn.randrange(len(whole))
        yield f"{name} cut at {at}", whole[:at]
    for _ in range(5):
        changed = bytearray(whole)
        for _ in range(drawn.choice([1, 10, 100])):
            changed[drawn.randrange(min(len(changed), 4096))] = drawn.randrange(256)
        yield f"{name} with other bytes", bytes(changed)
    yield f"{name} twice", whole * 2
    yield f"{name} behind garbage", drawn.randbytes(100) + whole


_SETTINGS = [
    b"", b"[]", b"null", b"3", b"{", b"\xff\xfe\x00", b"[" * 200_000, b'{"a":' * 200_000,
    b'{"r": NaN}', b'{"a": ' + b"9" * 100_000 + b"}",
]  # fmt: skip


def hostile_settings(whole: dict[str, Any]) -> Iterator[Case]:
    """A table of settings with each of its values replaced by ones that it cannot have."""
    for content in _SETTINGS:
        yield f"{content[:20]!r}", content
    drawn = random.Random(_SEED)
    for key, value in whole.items():
        for odd in drawn.sample([10**9, -1, 10**400, 1e300, "x", None, [], {}, [[1]], True], 4):
            if type(odd) is not type(value) or odd != value:
                yield f"{key}={str(odd)[:20]}", json.dumps({**whole, key: odd}).encode()
    for key in whole:
        yield f"without {key}", json.dumps({k: v for k, v in whole.items() if k != key}).encode()


def hostile_files(state: dict[str, torch.Tensor], target: Path) -> Iterator[tuple[str, str, bytes]]:
    """Name, suffix, content."""
    for suffix, cases in (
        (".pth", [*hostile_pickles(target), *_saved_by_torch(state, target)]),
        (".safetensors", [*hostile_safetensors(state), *list(hostile_pickles(target))[:8]]),
    ):
        for name, content in cases:
            yield f"{name}{suffix}", suffix, content
