"""Hostile and damaged weights at every option that takes some: each is refused in one line or read,
nothing of it is run, and neither memory nor time runs away.

`python -m pytest -m slow tests/diffusion/test_fuzzed_weights.py` takes a few minutes.
"""

import io
import json
import multiprocessing
import os
import pickle
import random
import resource
import shutil
import struct
import time
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save as save_safetensors
from torch import nn
from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, DPTImageProcessor

from extrap_train.config import AlikedMatcherConfig, LoftrMatcherConfig, LoraConfig, ModelConfig
from extrap_train.depth.depth_anything import read_depth_anything
from extrap_train.depth.mast3r.mast3r_checkpoint import read_network
from extrap_train.diffusion.lora import AdapterOrigin, add_adapter, load_adapter, save_adapter
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import initial_model, load_model, save_model
from extrap_train.errors import InputError
from extrap_train.matching.aliked import read_aliked
from extrap_train.matching.loftr import read_loftr
from extrap_train.metrics import BACKBONES, lpips_distance, squeeze_lpips

pytestmark = pytest.mark.slow

_MOST_BYTES, _MOST_SECONDS = 4 * 2**30, 20.0
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


def _pickles(target: Path) -> Iterator[Case]:
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
    yield from _damaged("torch", whole)


def _safetensors(state: dict[str, torch.Tensor]) -> Iterator[Case]:
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
    yield from _damaged("safetensors", save_safetensors(state))


def _damaged(name: str, whole: bytes) -> Iterator[Case]:
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


def _settings(whole: dict[str, Any]) -> Iterator[Case]:
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


def _measured(read: Callable[[], Any], sender: Any) -> None:
    """In a process of its own: what became of one input, and what it took."""
    began = time.process_time()  # a busy machine is not the file's fault
    try:
        read()
        said = "read"
    except InputError as error:
        said = "refused" if "\n" not in str(error) else f"several lines: {error}"
    except BaseException as error:  # anything else would be a traceback
        said = f"{type(error).__name__}: {error}"[:300]
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    sender.send((said, time.process_time() - began, peak))


def _outcome(read: Callable[[], Any]) -> tuple[str, float, int]:
    """Forked, so that a file that ends or bloats its process tells so."""
    receiver, sender = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=_measured, args=(read, sender))
    process.start()
    sender.close()
    try:
        found = receiver.recv() if receiver.poll(10 * _MOST_SECONDS) else ("no end", 99.0, 0)
    except EOFError:
        found = "the process died", 0.0, 0
    if process.is_alive() and found[0] == "no end":
        process.kill()
    process.join()
    return found


@pytest.fixture(scope="module")
def state() -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(8, 8), nn.LayerNorm(8)).state_dict()


def _files(state: dict[str, torch.Tensor], target: Path) -> Iterator[tuple[str, str, bytes]]:
    """Name, suffix, content."""
    for suffix, cases in (
        (".pth", [*_pickles(target), *_saved_by_torch(state, target)]),
        (".safetensors", [*_safetensors(state), *list(_pickles(target))[:8]]),
    ):
        for name, content in cases:
            yield f"{name}{suffix}", suffix, content


_READERS: dict[str, Callable[[Path], Any]] = {
    "model.start": lambda path: initial_model(ModelConfig(name="tiny", start=str(path))),
    "depth.checkpoint": lambda path: read_network(path),
    "matcher.checkpoint=loftr": lambda path: read_loftr(path, LoftrMatcherConfig(), "option"),
    "matcher.checkpoint=aliked": lambda path: read_aliked(path, AlikedMatcherConfig(), "option"),
    "validation.lpips_weights": lambda path: lpips_distance("squeeze", str(path), "option"),
}


def _require_sound(
    cases: Iterator[tuple[str, Callable[[], Any]]], target: Path, least: int
) -> None:
    count, wrong = 0, []
    for name, read in cases:
        said, seconds, peak = _outcome(read)
        count += 1
        if said not in ("read", "refused") or seconds > _MOST_SECONDS or peak > _MOST_BYTES:
            wrong.append(f"{name}: {said} after {seconds:.1f} s with {peak >> 20} MiB")
        if target.exists():
            wrong.append(f"{name}: was executed")
            target.unlink()
    assert not wrong, "\n".join(wrong)
    assert count >= least


@pytest.mark.parametrize("option", _READERS)
def test_hostile_files(option: str, state: dict[str, torch.Tensor], tmp_path: Path) -> None:
    def cases() -> Iterator[tuple[str, Callable[[], Any]]]:
        for name, suffix, content in _files(state, tmp_path / "ran"):
            path = tmp_path / f"weights{suffix}"
            path.write_bytes(content)
            yield name, lambda path=path: _READERS[option](path)
            path.unlink()

    _require_sound(cases(), tmp_path / "ran", least=110)


def test_hostile_backbones_in_the_hub_cache(
    state: dict[str, torch.Tensor], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    file = tmp_path / "hub" / "checkpoints" / BACKBONES["squeeze"]
    file.parent.mkdir(parents=True)

    def cases() -> Iterator[tuple[str, Callable[[], Any]]]:
        for name, _, content in _files(state, tmp_path / "ran"):
            file.write_bytes(content)
            yield name, lambda: squeeze_lpips(None)

    _require_sound(cases(), tmp_path / "ran", least=110)


def _tiny(config: ModelConfig) -> ExtrapolationModel:
    torch.manual_seed(0)
    return ExtrapolationModel(config).eval()


def _model_folder(config: ModelConfig, folder: Path) -> Callable[[], Any]:
    save_model(_tiny(config), folder)
    return lambda: load_model(folder)


def _adapter_folder(config: ModelConfig, folder: Path) -> Callable[[], Any]:
    model = _tiny(config)
    adapter = add_adapter(model, LoraConfig(rank=2), seed=0)
    origin = AdapterOrigin("/scene", {"a.jpg": "0" * 64}, "base", {}, "kept step 1 of 1")
    save_adapter(model, adapter, folder, origin)
    adapter.unload()
    return lambda: load_adapter(model, folder)


def _depth_anything_folder(_: ModelConfig, folder: Path) -> Callable[[], Any]:
    backbone = {
        "model_type": "dinov2", "hidden_size": 16, "num_hidden_layers": 4,
        "num_attention_heads": 2, "image_size": 28, "patch_size": 14,
        "out_indices": [1, 2, 3, 4], "reshape_hidden_states": False, "apply_layernorm": True,
    }  # fmt: skip
    config = DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, neck_hidden_sizes=[4, 4, 8, 8],
        fusion_hidden_size=8, head_hidden_size=4,
    )  # fmt: skip
    DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    DPTImageProcessor(size={"height": 28, "width": 28}).save_pretrained(folder)
    return lambda: read_depth_anything(str(folder), torch.device("cpu"))


@pytest.mark.parametrize(
    ("make", "tables", "weights"),
    [
        (
            _model_folder,
            ["extrapolation_model.json"],
            "unet/diffusion_pytorch_model.safetensors",
        ),
        (_adapter_folder, ["adapter_config.json", "base.json"], "adapter_model.safetensors"),
        (
            _depth_anything_folder,
            ["config.json", "preprocessor_config.json"],
            "model.safetensors",
        ),
    ],
    ids=["weights", "adapter", "depth.model"],
)
def test_hostile_folders(
    make: Callable[[ModelConfig, Path], Callable[[], Any]],
    tables: list[str],
    weights: str,
    config: ModelConfig,
    state: dict[str, torch.Tensor],
    tmp_path: Path,
) -> None:
    folder = tmp_path / "folder"
    read = make(replace(config), folder)
    assert _outcome(read)[0] == "read"

    def cases() -> Iterator[tuple[str, Callable[[], Any]]]:
        for table in tables:
            whole = (folder / table).read_bytes()
            for name, content in _settings(json.loads(whole)):
                (folder / table).write_bytes(content)
                yield f"{table}: {name}", read
            (folder / table).write_bytes(whole)
        whole = (folder / weights).read_bytes()
        for name, content in [*_safetensors(state), *_pickles(tmp_path / "ran")]:
            (folder / weights).write_bytes(content)
            yield f"{weights}: {name}", read
        for name, content in _damaged("its own", whole):
            (folder / weights).write_bytes(content)
            yield f"{weights}: {name}", read
        (folder / weights).unlink()
        (folder / weights).with_name("pytorch_model.bin").write_bytes(pickle.dumps(Bomb(folder)))
        yield "a pickle in its place", read
        shutil.rmtree(folder)
        yield "gone", read

    _require_sound(cases(), tmp_path / "ran", least=110)
