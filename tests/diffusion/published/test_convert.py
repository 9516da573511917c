"""`task=convert`: the folder holds the published network, for plain diffusers as for commands."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from published_networks import Reference, configured, tiny_config
from torch import Tensor
from transformers import CLIPVisionModelWithProjection

from extrap_train import open_generator
from extrap_train.__main__ import main
from extrap_train.diffusion import model_files
from extrap_train.diffusion.leakage import trainings_of, unrecorded_models
from extrap_train.diffusion.model_files import load_model, published_config, save_model
from extrap_train.diffusion.published.read import weights_at
from extrap_train.store.digests import weights_digest
from tests.in_process import run_command


def _convert(weights: Path, to: Path, status: int = 0) -> str:
    return run_command(main, "task=convert", f"weights={weights}", f"to={to}", status=status)


def _refused(weights: Path, to: Path) -> str:
    """The one line that is said; nothing is left of the folder."""
    message = _convert(weights, to, status=1)
    assert message.startswith("error: ")
    assert message.count("\n") == 1
    assert not list(to.parent.glob(f".{to.name}*.tmp"))
    return message


@pytest.fixture(scope="module")
def converted(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("converted") / "model"
    _convert(checkpoint, folder)
    return folder


def _near(found: Tensor, expected: Tensor) -> None:
    assert float((found - expected).abs().max()) <= 1e-4 * float(expected.std())


@torch.no_grad()
def test_plain_diffusers_computes_what_the_published_code_did(
    converted: Path, reference: Reference
) -> None:
    given = reference.expected
    vae = AutoencoderKL.from_pretrained(converted / "vae")
    _near(vae.encode(given["image"]).latent_dist.mean, given["vae_mean"])
    _near(vae.decode(given["latent"]).sample, given["vae_decoded"])
    tower = CLIPVisionModelWithProjection.from_pretrained(converted / "image_encoder")
    _near(tower(given["clip_input"]).image_embeds, given["clip_embedding"])
    unet = UNet2DConditionModel.from_pretrained(converted / "unet")
    token = given["token"].expand(2, -1, -1)
    output = unet(given["unet_input"], given["unet_timestep"], token).sample
    _near(output, given["unet_output"])


def test_it_is_the_checkpoint_to_the_bit(converted: Path, checkpoint: Path) -> None:
    again, opened = load_model(converted), open_generator(str(checkpoint)).model
    assert replace(again.config, start=None) == opened.config
    for part, network in opened.parts().items():
        state = again.parts()[part].state_dict()
        assert all(torch.equal(state[name], x) for name, x in network.state_dict().items())


def test_the_manifest_names_the_source_and_no_capture_of_ours(
    converted: Path, checkpoint: Path
) -> None:
    manifest = json.loads((converted / "manifest.json").read_text())
    assert manifest["inputs"] == {"published checkpoint": weights_digest(weights_at(checkpoint))}
    assert unrecorded_models(str(converted)) == []
    assert [t.split.train for t in trainings_of(str(converted))] == [()]


def test_a_second_conversion_reuses_the_folder_and_another_source_does_not_replace_it(
    converted: Path, checkpoint: Path, references: dict[str, Reference], tmp_path: Path
) -> None:
    file = converted / "unet" / "diffusion_pytorch_model.safetensors"
    before = file.stat().st_ino
    _convert(checkpoint, converted)
    assert file.stat().st_ino == before
    state = references["zeronvs"].state | {"cc_projection.bias": torch.ones(768)}
    torch.save(state, tmp_path / "other.ckpt")
    said = _convert(tmp_path / "other.ckpt", converted, status=1)
    assert "resume=false" in said
    assert file.stat().st_ino == before


@pytest.mark.parametrize("family", ["zeronvs", "megascenes"])
def test_family_and_size_are_recognised(
    references: dict[str, Reference], tmp_path: Path, family: str
) -> None:
    """By names and shapes, in a single file as in a plain diffusers folder."""
    torch.save(references[family].state, tmp_path / "weights.ckpt")
    found = published_config(str(tmp_path / "weights.ckpt"))
    tiny = tiny_config(family, name=family)
    assert (found.unet, found.vae, found.clip) == (tiny.unet, tiny.vae, tiny.clip)
    assert (found.name, found.family, found.prediction) == (family, family, "epsilon")
    assert found.sampler == configured(family).sampler
    save_model(open_generator(str(tmp_path / "weights.ckpt")).model, tmp_path / "plain")
    (tmp_path / "plain" / "extrapolation_model.json").unlink()
    assert published_config(str(tmp_path / "plain")) == found


def test_tensors_are_written_from_the_mapped_file(
    references: dict[str, Reference], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only what is turned on the way (CLIP's projection) is ever a copy in memory."""
    source = tmp_path / "zeronvs.ckpt"
    torch.save({"state_dict": references["zeronvs"].state}, source)
    copied, write = [], model_files.write_tensors

    def watched(tensors: Mapping[str, Tensor], path: Path) -> None:
        spans = _mapped(source)
        copied.extend(
            name for name, x in tensors.items() if not any(x.data_ptr() in span for span in spans)
        )
        write(tensors, path)

    monkeypatch.setattr(model_files, "write_tensors", watched)
    _convert(source, tmp_path / "model")
    assert copied == ["visual_projection.weight"]


def _mapped(file: Path) -> list[range]:
    lines = Path("/proc/self/maps").read_text().splitlines()
    spans = [line.split()[0].split("-") for line in lines if line.endswith(str(file))]
    return [range(int(low, 16), int(high, 16)) for low, high in spans]


@pytest.mark.parametrize("kind", ["text", "small", "cut", "tensorless", "huge", "empty"])
def test_what_is_no_such_checkpoint_is_refused_and_leaves_nothing(
    references: dict[str, Reference], tmp_path: Path, kind: str
) -> None:
    state = dict(references["zeronvs"].state)
    first = "model.diffusion_model.input_blocks.0.0.weight"
    if kind == "text":
        state[first] = state[first][:, :4].clone()
    elif kind == "small":
        state = {n: x for n, x in state.items() if ".middle_block." not in n}
    elif kind == "tensorless":
        state = {"model.diffusion_model.x": torch.zeros(1)}
    elif kind == "huge":
        state["first_stage_model.encoder.down.9999999.block.0.conv1.weight"] = torch.zeros(1)
    elif kind == "empty":
        state["cond_stage_model.model.visual.class_embedding"] = torch.zeros(0)
    file = tmp_path / "x.ckpt"
    torch.save({"state_dict": state}, file)
    if kind == "cut":
        file.write_bytes(file.read_bytes()[:-1000])
    assert str(file) in _refused(file, tmp_path / "model")
    assert not (tmp_path / "model").exists()


def test_a_folder_that_is_no_result_is_left_alone(checkpoint: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    _refused(checkpoint, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_options_that_are_missing_and_models_that_need_no_conversion(
    converted: Path, tmp_path: Path
) -> None:
    assert "to=FOLDER" in run_command(main, "task=convert", "weights=x.ckpt", status=1)
    assert "already" in _refused(converted, tmp_path / "again")
    assert "weights=" in _refused(tmp_path / "none.ckpt", tmp_path / "again")
