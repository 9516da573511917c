"""A tiny untrained model in transformers' layout: what is read, and what is refused."""

import json
import os
import re
import shutil

import pytest
import torch
from huggingface_hub import constants
from transformers import (
    DepthAnythingConfig,
    DepthAnythingForDepthEstimation,
    Dinov2Config,
    DPTImageProcessor,
)

from data_prep.model_cache import PrepModels
from extrap_train.config import FlowMatcherConfig, MonocularConfig
from extrap_train.depth.depth_anything import files_read, read_depth_anything
from extrap_train.depth.monocular import MonocularDepth
from extrap_train.depth.sources import depth_source
from extrap_train.errors import InputError


@pytest.fixture
def folder(tmp_path):
    torch.manual_seed(0)
    backbone = Dinov2Config(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        image_size=56,
        patch_size=14,
        out_features=["stage1", "stage2", "stage3", "stage4"],
        reshape_hidden_states=False,
        apply_layernorm=True,
    )
    config = DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=16,
        neck_hidden_sizes=[4, 4, 8, 8],
        fusion_hidden_size=8,
        head_hidden_size=4,
    )
    DepthAnythingForDepthEstimation(config).save_pretrained(tmp_path)
    DPTImageProcessor(
        size={"height": 56, "width": 56}, ensure_multiple_of=14, keep_aspect_ratio=True
    ).save_pretrained(tmp_path)
    return tmp_path


def test_a_folder_becomes_a_source_and_pictures_keep_their_size(folder):
    source = depth_source(MonocularConfig(model=str(folder), matcher=FlowMatcherConfig()))
    assert isinstance(source, MonocularDepth)
    assert source.image_size == 56
    assert "DepthAnythingForDepthEstimation" not in repr(source)
    image = torch.rand(3, 40, 70, generator=torch.Generator().manual_seed(0))
    found = source.network.inverse_depth(image)
    assert found.shape == (40, 70)
    assert found.isfinite().all()


def test_metric_models_are_turned_into_inverse_depth(folder):
    image = torch.rand(3, 56, 56, generator=torch.Generator().manual_seed(0))
    relative = read_depth_anything(str(folder)).inverse_depth(image)
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"depth_estimation_type": "metric"}))
    metric = read_depth_anything(str(folder))
    with torch.no_grad():
        pixels = metric.processor(images=image, do_rescale=False, return_tensors="pt")
        depth = metric.network(pixel_values=pixels["pixel_values"]).predicted_depth[0]
    assert not torch.allclose(relative, metric.inverse_depth(image))
    torch.testing.assert_close(metric.inverse_depth(image), 1 / depth)


def test_a_size_of_its_own_for_the_network_does_not_shift_the_picture(folder):
    image = torch.rand(3, 56, 84, generator=torch.Generator().manual_seed(0))
    found = read_depth_anything(str(folder)).inverse_depth(image)
    assert found.shape == (56, 84)


def refused(model, said):
    with pytest.raises(InputError, match=re.escape(said)) as raised:
        depth_source(MonocularConfig(model=str(model), matcher=FlowMatcherConfig()))
    message = str(raised.value)
    assert "\n" not in message
    assert str(model) in message
    assert "depth.model=FOLDER" in message
    assert "huggingface.co/depth-anything" in message


def test_absent(tmp_path):
    refused(tmp_path / "nowhere", "is neither a folder nor in the cache of downloads")
    refused("nobody/no-such-model", "is neither a folder nor in the cache of downloads")


def test_another_model(folder):
    path = folder / "config.json"
    path.write_text(json.dumps({"model_type": "dinov2"}))
    refused(folder, "is a model of kind dinov2")


def test_truncated_or_incomplete_weights(folder):
    weights = folder / "model.safetensors"
    content = json.loads((folder / "config.json").read_text())
    more = content | {"neck_hidden_sizes": [4, 4, 8, 16]}
    (folder / "config.json").write_text(json.dumps(more))
    refused(folder, "depth.model=FOLDER")
    (folder / "config.json").write_text(json.dumps(content))
    os.truncate(weights, weights.stat().st_size // 2)
    refused(folder, "is cut off")
    weights.unlink()
    torch.save({}, folder / "pytorch_model.bin")  # pickles are not read
    refused(folder, "holds 0 numbers")


def test_code_in_the_folder_is_refused_without_a_question(folder, tmp_path, monkeypatch):
    ran = tmp_path / "ran"
    (folder / "evil.py").write_text(f"open({str(ran)!r}, 'w')\nclass Config: pass\n")
    classes = {"AutoConfig": "evil.Config", "AutoImageProcessor": "evil.Config"}
    monkeypatch.setattr("builtins.input", lambda *_: "y")
    for name, kind in (("config.json", "evil"), ("preprocessor_config.json", "DPTImageProcessor")):
        whole = (folder / name).read_text()
        more = {"model_type": kind, "image_processor_type": "Evil", "auto_map": classes}
        (folder / name).write_text(json.dumps(json.loads(whole) | more))
        refused(folder, "contains custom code")
        (folder / name).write_text(whole)
    assert not ran.exists()


def test_a_size_of_the_shorter_side_alone(folder):
    path = folder / "preprocessor_config.json"
    content = json.loads(path.read_text()) | {"size": {"shortest_edge": 56}}
    path.write_text(json.dumps(content))
    refused(folder, "has no size.height in its preprocessor_config.json")


def test_only_what_is_read_tells_weights_apart(folder):
    (folder / "README.md").write_text("a model")
    (folder / ".git").mkdir()
    names = [file.name for file in files_read(str(folder))]
    assert names == ["config.json", "model.safetensors", "preprocessor_config.json"]
    assert files_read(str(folder / "nowhere")) == []
    assert files_read("nobody/no-such-model") == []


def test_a_new_revision_of_a_downloaded_model_is_other_weights(folder, tmp_path, monkeypatch):
    cache = tmp_path / "hub"
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache))
    model = cache / "models--somebody--some-model"
    (model / "refs").mkdir(parents=True)
    options, found = MonocularConfig(model="somebody/some-model", matcher=FlowMatcherConfig()), []
    for revision in ("a" * 40, "b" * 40):
        (model / "refs" / "main").write_text(revision)
        (model / "snapshots" / revision).mkdir(parents=True)
        for file in files_read(str(folder)):
            shutil.copy(file, model / "snapshots" / revision)
        found.append(PrepModels(options, None).depth_identity)
        assert {file.parent.name for file in files_read(options.model)} == {revision}
    assert found[0] != found[1]
