"""Files that the project wrote itself, damaged at random: one line each, or still whole.

`python -m pytest -m slow tests/tasks/test_damaged_results.py`
"""

import json
import os
import pickle
import resource
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from captures import write_capture
from scenes import orbit_camera

from data_prep.preparation import prepare
from extrap_train.config import LoraConfig, ModelConfig, PrepConfig, UNetConfig
from extrap_train.data.co3d import read_category
from extrap_train.data.prepared import PreparedData
from extrap_train.depth import DatasetDepth
from extrap_train.diffusion.lora import AdapterOrigin, add_adapter, load_adapter, save_adapter
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.errors import InputError
from extrap_train.reconstruction.completion import Step
from extrap_train.reconstruction.global_map import GENERATED, GIVEN, GlobalMap, Origin
from extrap_train.reconstruction.map_files import (
    load_input_seconds,
    load_map,
    load_steps,
    save_input_seconds,
    save_view,
)
from extrap_train.store.manifest import MANIFEST, Manifest, read_manifest
from extrap_train.store.records import write_record
from extrap_train.views import View

pytestmark = pytest.mark.slow

INPUTS_PER_KIND = 80
MAX_SECONDS, MAX_KIB = 20.0, 4 * 2**20
_UNET = UNetConfig(channels=[16, 32], attention_levels=[False, True], heads=2, token_width=16)
_TINY = ModelConfig(name="tiny", image_size=16, octaves=2, unet=_UNET)


class _Payload:
    """Makes a file if it is ever unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.marker),)


def _leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    pairs = value.items() if isinstance(value, dict) else enumerate(value)
    found = []
    for key, item in pairs:
        found.append((*path, key))
        if isinstance(item, dict | list):
            found += _leaves(item, (*path, key))
    return found


_ODD = [None, [], {}, "", "x" * 1000, -1, 10**9, 10**400, 1e308, True, "NaN", "../../etc/passwd"]


def _damaged(content: bytes, name: str, rng: np.random.Generator, marker: Path) -> bytes:
    """The content with damage of a random kind."""
    kind = int(rng.integers(6 if name.endswith(".json") else 4))
    if kind == 0:
        flipped = bytearray(content)
        for _ in range(int(rng.integers(1, 4))):
            flipped[int(rng.integers(len(flipped)))] ^= 1 << int(rng.integers(8))
        return bytes(flipped)
    if kind == 1:
        return content[: int(rng.integers(len(content)))]
    if kind == 2:
        return [b"[" * 200_000, b'{"a":' * 100_000, b"", b"\xff" * 64][int(rng.integers(4))]
    if kind == 3:
        array = np.array([_Payload(marker)], dtype=object)
        shutil.rmtree(marker, ignore_errors=True)
        return [pickle.dumps(_Payload(marker)), b"\x93NUMPY\x01\x00", array.dumps()][
            int(rng.integers(3))
        ]
    tree = json.loads(content)
    *parents, key = _leaves(tree)[int(rng.integers(len(_leaves(tree))))]
    place = tree
    for parent in parents:
        place = place[parent]
    if kind == 4:
        place[key] = _ODD[int(rng.integers(len(_ODD)))]
    else:
        del place[key]
    return json.dumps(tree).encode()


def _map(folder: Path) -> Callable[[], object]:
    rng = np.random.default_rng(1)
    known = GlobalMap(0.01)
    for index in range(4):
        image = torch.from_numpy(rng.random((3, 16, 16), np.float32))
        view = View(image, orbit_camera(20 * index, size=16), 2 + image[0], name=f"v{index}")
        origin = Origin(GIVEN if index < 2 else GENERATED, root=min(index, 1))
        known, added = known.added(view, torch.ones(16, 16), origin)
        step = Step(f"v{index}", 0.9, 1, 2, 30, None, {"plan": 0.1}) if index > 1 else None
        save_view(added, step, folder, index)
    save_input_seconds(1.5, folder)

    def read() -> None:
        load_steps(folder, len(load_map(folder, 0.01)))
        load_input_seconds(folder)

    return read


def _adapter(folder: Path) -> Callable[[], object]:
    torch.manual_seed(0)
    model = ExtrapolationModel(_TINY)
    adapter = add_adapter(model, LoraConfig(rank=2), seed=0)
    origin = AdapterOrigin("synthetic:cup/0000", {"a": "b"}, "base")
    save_adapter(model, adapter, folder, origin)
    adapter.unload()
    return lambda: load_adapter(model, folder).unload()


def _prepared(folder: Path) -> Callable[[], object]:
    write_capture(folder / "co3d", ("a", "b"), frames=12)
    sequences = read_category(folder / "co3d", "cup")
    prepare(
        sequences,
        DatasetDepth(),
        PrepConfig(image_size=16),
        test_names=1,
        folder=folder / "data",
        progress=False,
        source={"name": "co3d"},
    )

    def read() -> None:
        data = PreparedData.open(folder / "data")
        for split in ("train", "test"):
            for pair in list(data.pairs(split))[:2]:
                data.images(pair.sequence, [pair.query])
                data.depths(pair.sequence, [pair.query])
                data.flows(pair.sequence, pair.references, pair.query)
                data.cameras(pair.sequence)
                data.names(pair.sequence)

    return read


def _manifest(folder: Path) -> Callable[[], object]:
    write_record(folder / MANIFEST, Manifest.of({"a": 1, "b": [2.5, None]}, {"weights": "ab"}))
    return lambda: Manifest.of({"a": 1}).differences(read_manifest(folder))


_KINDS = {"map": _map, "adapter": _adapter, "prepared": _prepared, "manifest": _manifest}


@pytest.mark.parametrize("kind", list(_KINDS))
def test_damage_is_one_line_and_costs_neither_memory_nor_time(kind: str, tmp_path: Path) -> None:
    folder, marker = tmp_path / kind, tmp_path / "executed"
    folder.mkdir()
    read = _KINDS[kind](folder)
    read()
    files = [
        p for p in sorted(folder.rglob("*")) if p.is_file() and p.suffix not in (".lock", ".md")
    ]
    files = [p for p in files if "co3d" not in p.parts and p.stat().st_size]
    rng = np.random.default_rng(18)
    refused = 0
    for number in range(INPUTS_PER_KIND):
        file = files[number % len(files)]
        whole = file.read_bytes()
        file.write_bytes(_damaged(whole, file.name, rng, marker))
        started, lines = time.process_time(), [""]
        try:
            read()
        except InputError as error:
            refused += 1
            lines = str(error).splitlines()
        finally:
            file.write_bytes(whole)
        assert len(lines) == 1
        assert time.process_time() - started < MAX_SECONDS
        assert not marker.exists()
    assert refused > INPUTS_PER_KIND // 4
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < MAX_KIB
    read()
