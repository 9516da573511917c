"""Networks are made where they run: what a job takes along is small and holds nothing open.

`python -m pytest -m slow tests/data_prep/test_model_cache.py` prepares with a network in two
processes that may have few files open.
"""

import argparse
import pickle
import shlex
import subprocess
import sys
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import pytest
import torch
from captures import write_capture
from kornia.feature import LoFTR

from data_prep.category_pairs import prepare_category
from data_prep.model_cache import PrepModels, release_models
from data_prep.sequence_job import PrepContext, SequenceJob
from extrap_train.config import (
    FlowMatcherConfig,
    LoftrMatcherConfig,
    Mast3rConfig,
    PrepConfig,
    SyntheticConfig,
)
from extrap_train.data.prepared import PreparedData
from extrap_train.data.sequences import FrameSequence
from extrap_train.depth import DatasetDepth
from extrap_train.depth.mast3r.network.point_map_network import Architecture, PointMapNetwork
from extrap_train.errors import InputError

THIN = Architecture(
    encoder_width=16, encoder_heads=2, decoder_width=8, decoder_heads=2, descriptor_width=1
)
"""As deep as the published network, so with as many tensors."""
FEW = 256


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.fixture(scope="module")
def mast3r(tmp_path_factory: pytest.TempPathFactory) -> Mast3rConfig:
    file = tmp_path_factory.mktemp("weights") / "thin.pth"
    heads = argparse.Namespace(model="Network(enc_num_heads=2, dec_num_heads=2)")
    torch.save({"args": heads, "model": PointMapNetwork(THIN).state_dict()}, file)
    return Mast3rConfig(checkpoint=str(file))


def test_a_job_is_small_and_keeps_no_file_open(mast3r: Mast3rConfig, tmp_path: Path) -> None:
    tools = PrepModels(mast3r, LoftrMatcherConfig(checkpoint="loftr.ckpt"))
    shop = PrepContext(tools, PrepConfig(), tmp_path, tmp_path)
    before = open_files()
    job = ForkingPickler.dumps(SequenceJob(shop, FrameSequence("cup", "one", ()), "train", "key"))
    assert open_files() == before
    assert len(job) < 2000


def test_a_process_makes_its_tools_once_and_can_let_go_of_them(mast3r: Mast3rConfig) -> None:
    tools = PrepModels(mast3r, None)
    first = tools.depth_source()
    assert pickle.loads(pickle.dumps(tools)).depth_source() is first
    assert tools.matcher() is None
    release_models()
    assert tools.depth_source() is not first
    release_models()
    ready = DatasetDepth()
    assert PrepModels(ready, None).depth_source() is ready


def test_weights_that_cannot_be_used_are_refused_before_anything_is_rendered(
    tmp_path: Path,
) -> None:
    with pytest.raises(InputError, match=r"no\.pth: there is no such file; give depth.checkpoint"):
        prepare_category(
            "hydrant",
            SyntheticConfig(frames=2, image_size=8),
            Mast3rConfig(checkpoint=str(tmp_path / "no.pth")),
            PrepConfig(image_size=8),
            output=tmp_path / "outputs",
            workers=1,
            matcher=LoftrMatcherConfig(),
        )
    assert not (tmp_path / "outputs").exists()


@pytest.mark.slow
def test_two_processes_with_a_network_need_few_open_files(tmp_path: Path) -> None:
    write_capture(tmp_path / "co3d", ("one", "two", "three", "four", "five"), 8, step_deg=45)
    weights = tmp_path / "loftr.ckpt"
    torch.save({"state_dict": LoFTR(pretrained=None).state_dict()}, weights)
    options = [
        "category=cup",
        "data=co3d",
        f"data.root={tmp_path / 'co3d'}",
        f"output={tmp_path / 'outputs'}",
        "prep.image_size=16",
        "prep.max_gap_deg=60",
        "prep.max_uses=2",
        "matcher=loftr",
        "matcher.image_size=32",
        f"matcher.checkpoint={weights}",
        "workers=2",
    ]
    command = shlex.join([sys.executable, "-m", "data_prep", *options])
    script = f"ulimit -n {FEW}; exec {command}"
    subprocess.run(["bash", "-c", script], check=True, timeout=200)
    (folder,) = (tmp_path / "outputs" / "data").glob("cup-*")
    assert len(LoFTR(pretrained=None).state_dict()) * 2 > FEW, "or two waiting jobs would fit"
    assert PreparedData.open(folder).manifest["sequences"]["kept"] == 5


def test_other_weights_under_the_same_name_are_other_tools(tmp_path: Path) -> None:
    weights, options = tmp_path / "loftr.ckpt", LoftrMatcherConfig()
    options.checkpoint = str(weights)
    absent = PrepModels(DatasetDepth(), options).correction_identity
    weights.write_bytes(b"some")
    first = PrepModels(DatasetDepth(), options).correction_identity
    weights.write_bytes(b"others")
    assert len({absent, first, PrepModels(DatasetDepth(), options).correction_identity}) == 3
    assert PrepModels(DatasetDepth(), None).correction_identity == ""


def test_processes_do_not_share_a_gpu_that_holds_a_network(
    mast3r: Mast3rConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(8))
    networks = PrepModels(mast3r, None), PrepModels(DatasetDepth(), LoftrMatcherConfig())
    assert [tools.default_workers() for tools in networks] == [8, 8]
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert [tools.default_workers() for tools in networks] == [1, 1]
    assert PrepModels(DatasetDepth(), FlowMatcherConfig()).default_workers() == 8
