"""A training whose pairs come from an object store, which here is a server on the loopback.

python -m pytest -s -m slow tests/test_training_from_shards.py    # prints examples per second
"""

import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from statistics import median

import fsspec
import numpy as np
import pandas as pd
import pytest
import torch
from object_store import SECRET, ObjectStore, serve_objects
from orbits import capture, even, ring
from prepared import prepared_captures
from tiny_job import TINY
from torch import Tensor
from torch.utils.data import DataLoader

from extrap_train.data.examples import ExampleReader
from extrap_train.data.module import PositionSampler, TrainingBatches
from extrap_train.data.prepared import PreparedData
from extrap_train.data.shards import open_shards, write_shards
from extrap_train.views import combine

pytestmark = pytest.mark.slow

_TRAINING = [
    "trainer.steps=40",
    "trainer.checkpoint_every=10",
    "trainer.validate_every=40",
    "validation.examples=4",
    "sampler.steps=1",
    "run=here",
    "prep.correct=true",
]
_LARGER = [
    "category=hydrant",
    "data.test_sequences=1",
    "data.train_sequences=5",
    "data.frames=12",
    "data.image_size=512",
    "prep.image_size=512",
    "prep.max_gap_deg=60",
]


@pytest.fixture(scope="module")
def store() -> Iterator[ObjectStore]:
    with serve_objects() as store:
        yield store


def _run(module: str, *options: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-m", module, *options],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=600,
    )


def _done(module: str, *options: str) -> str:
    run = _run(module, *options)
    assert run.returncode == 0, run.stdout
    return run.stdout


def test_a_machine_without_captures_trains_what_one_with_them_does(
    store: ObjectStore, tmp_path: Path
) -> None:
    """The same weights and scores of the same held-out views, to the bit; killed halfway, too, and
    without the shards that it had fetched until then.
    """
    here, elsewhere = tmp_path / "here", tmp_path / "elsewhere"
    shards = f"shards={store.url}/trained"
    prepared = [option for option in TINY if option.startswith(("category", "data.", "prep."))]
    _done("data_prep", *prepared, "prep.correct=true", f"output={here}", shards)
    _done("extrap_train", *TINY, *_TRAINING, f"output={here}")
    train = [*TINY, *_TRAINING, "trainer.workers=1", f"output={elsewhere}", shards]
    _kill_at_checkpoint(elsewhere, train)
    shutil.rmtree(elsewhere / "shards")
    _done("extrap_train", *train)
    assert not (elsewhere / "synthetic").exists()
    runs = [output / "train/hydrant/small/here" for output in (here, elsewhere)]
    tables = [pd.read_csv(run / "metrics.csv") for run in runs]
    pd.testing.assert_frame_equal(*tables)
    weights = [(run / "model/unet/diffusion_pytorch_model.safetensors") for run in runs]
    assert weights[0].read_bytes() == weights[1].read_bytes()
    summaries = [json.loads((run / "summary.json").read_text()) for run in runs]
    assert summaries[0]["validation"] == summaries[1]["validation"]
    manifests = [json.loads((run / "manifest.json").read_text()) for run in runs]
    for entry in ("inputs", "split"):
        assert manifests[0][entry] == manifests[1][entry]

    # What is read last of all, so that a worker process finds it: a sequence that is trained on.
    bucket = fsspec.filesystem("s3")
    manifest = json.loads(bucket.cat_file(f"{store.url}/trained/hydrant/preparation.json"))
    digest = manifest["shards"]["frames/hydrant/0001/frames.npy"]["sha256"]
    shard = f"{store.url}/trained/hydrant/files/{digest}"
    content = bucket.cat_file(shard)
    bucket.pipe_file(shard, content[:-1] + b"!")
    _fails(tmp_path / "damaged", shard, train)
    bucket.rm_file(shard)
    _fails(tmp_path / "missing", shard, train)


def _kill_at_checkpoint(output: Path, train: list[str]) -> None:
    """Start a training and kill it once its first checkpoint, which is not its last, is there."""
    command = [sys.executable, "-m", "extrap_train", *train]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT) as job:
        while job.poll() is None and not any(output.rglob("step-00000010.ckpt")):
            time.sleep(0.02)
        assert job.poll() is None
        job.kill()
    assert not any(output.rglob("step-00000040.ckpt"))


def _fails(output: Path, where: str, train: list[str]) -> None:
    """A training says in one line where it failed, and nothing about keys."""
    failed = _run("extrap_train", *train, f"output={output}")
    assert failed.returncode == 1
    (error,) = (line for line in failed.stdout.splitlines() if "error" in line.lower())
    assert error.startswith(f"error: {where}: ")
    assert SECRET not in failed.stdout


def test_processes_with_workers_share_the_examples_and_fetch_each_shard_once(
    store: ObjectStore, tmp_path: Path
) -> None:
    """Two ranks on one machine, each with two workers that start with nothing: together they read
    every example of a pass, none twice, and the batches of one that reads the prepared data.
    """
    captures = [capture(ring(even(24)), name, depth=2 + ord(name) / 100) for name in "abc"]
    data = prepared_captures(tmp_path / "cup-1", captures, {"c"})
    write_shards(data, "cup", f"{store.url}/shared")
    opened = open_shards(f"{store.url}/shared", "cup", tmp_path / "cache")
    store.fetched.clear()
    pairs = len(ExampleReader([data], "train", 3))
    batches = pairs // 8
    samplers = [
        PositionSampler(pairs, 4, batches, 0, steps_done=lambda: 0, rank=rank, world=2)
        for rank in range(2)
    ]
    reader = TrainingBatches(ExampleReader([opened], "train", 3), 0)
    ranks = [
        DataLoader(reader, None, sampler=each, num_workers=2, multiprocessing_context="spawn")
        for each in samplers
    ]
    expected = TrainingBatches(ExampleReader([data], "train", 3), 0)
    asked = [[*sampler] for sampler in samplers]
    for turn, found in enumerate(zip(*ranks, strict=True)):
        for rank, batch in enumerate(found):
            combine([batch, expected[asked[rank][turn]]], _same)
    seen = [pair for each in asked for batch in each for _, pair in batch]
    assert len(seen) == len(set(seen)) == batches * 8
    assert len(store.fetched) == len(set(store.fetched)) == 2  # the sequences that are trained on


def _same(tensors: Sequence[Tensor]) -> Tensor:
    assert torch.equal(*tensors)
    return tensors[0]


def test_no_key_is_printed_or_kept(store: ObjectStore, tmp_path: Path) -> None:
    """Where the store refuses it or cannot be reached, or the address contains it."""
    nowhere = f"http://{SECRET}:{SECRET}@127.0.0.1:9"
    data = ["category=hydrant", f"output={tmp_path}"]
    for address, endpoint in (
        ("s3://there-is-none/x", os.environ["AWS_ENDPOINT_URL"]),
        (f"{store.url}/x", nowhere),
        (f"s3://{SECRET}@bucket/x", nowhere),
    ):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("AWS_ENDPOINT_URL", endpoint)
            patch.setenv("AWS_MAX_ATTEMPTS", "1")
            failed = _run("extrap_train", *data, f"shards={address}")
        assert failed.returncode == 1
        assert failed.stdout.startswith("error: s")
        assert failed.stdout.count("\n") == 1
        assert SECRET not in failed.stdout
    kept = [file for file in tmp_path.rglob("*") if file.is_file()]
    assert not [file for file in kept if SECRET.encode() in file.read_bytes()]


def test_how_fast_examples_are_read(store: ObjectStore, tmp_path: Path) -> None:
    """Prints it; in a process of its own, as the server takes its part of this one."""
    _done("data_prep", *_LARGER, f"output={tmp_path}")
    (folder,) = (tmp_path / "data").glob("hydrant-*")
    addresses = {"a folder": str(tmp_path / "shards"), "the server": f"{store.url}/fast"}
    for address in addresses.values():
        write_shards(PreparedData.open(folder), "hydrant", address)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        rounds = [
            process.submit(_measure, folder, addresses, tmp_path / f"cache {number}").result()
            for number in range(4)
        ][1:]  # the first one loads libraries
    print()
    for what, unit in rounds[0]:
        rates, busy = zip(*(found[what, unit] for found in rounds), strict=True)
        print(f"{what}: {median(rates):.0f} {unit}/s, {median(busy):.2f} ms of a core each")


def _measure(
    folder: Path, addresses: dict[str, str], cache: Path
) -> dict[tuple[str, str], tuple[float, float]]:
    """Units per second and milliseconds of a core for each, of everything once."""
    data = PreparedData.open(folder)
    found = {("prepared data", "examples"): _time(data)}
    for kind, address in addresses.items():
        opened = open_shards(address, "hydrant", cache / kind)
        names = [name for name, role in opened.roles.items() if role == "train"]
        megabytes = sum(file.stat().st_size for name in names for _, file in data.files(name)) / 1e6
        began, cpu = time.perf_counter(), time.process_time()
        for name in names:
            opened.images(name, [0])
        found[f"fetching from {kind}", "MB"] = _rates(began, cpu, megabytes)
        found[f"shards of {kind}, fetched", "examples"] = _time(opened)
    return found


def _time(data: PreparedData) -> tuple[float, float]:
    reader, count = ExampleReader([data], "train", 3), 200
    order = np.random.default_rng(0).permutation(len(reader))[:count]
    began, cpu = time.perf_counter(), time.process_time()
    for index in order:
        rng = np.random.default_rng(int(index))
        reader.read(int(index), int(rng.integers(1, 4)), rng)
    return _rates(began, cpu, count)


def _rates(began: float, cpu: float, count: float) -> tuple[float, float]:
    seconds, busy = time.perf_counter() - began, time.process_time() - cpu
    return count / seconds, 1000 * busy / count
