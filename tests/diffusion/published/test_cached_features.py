"""Training on what the frozen networks have said of every frame beforehand is training on the
frames: the same numbers within half precision, and never those of other weights or frames.
"""

import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from orbits import capture, even, ring
from published_networks import TINY_MODEL, Reference, tiny_config

from data_prep import __main__ as data_prep
from data_prep.frame_features import encode_with
from data_prep.preparation import prepare
from extrap_train.__main__ import main
from extrap_train.config import PrepConfig, TrainConfig, TrainerConfig
from extrap_train.data.examples import ExampleReader
from extrap_train.data.feature_files import FeatureFiles
from extrap_train.data.module import TrainingBatches
from extrap_train.data.prepared import PreparedData
from extrap_train.depth import DatasetDepth
from extrap_train.diffusion.encoders import Frozen
from extrap_train.diffusion.frozen_features import frame_encoder
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.step_noise import StepNoise
from extrap_train.errors import InputError
from extrap_train.geometry.warp import compute_warp
from extrap_train.tasks.training_data import cached_encoder
from extrap_train.views import PairBatch

_SIZE = 64
_POSITIONS = [(position, 3 * position) for position in range(6)]
"""Of examples with one to three references, as they are and in a mirror."""


def _model(family: str = "ours") -> ExtrapolationModel:
    """All families with the same frozen networks."""
    torch.manual_seed(0)
    references = 3 if family == "ours" else 1
    config = tiny_config(family, image_size=_SIZE, references=references)
    model = ExtrapolationModel(config).eval()
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.05)
    for part, weights in _frozen_weights().items():
        model.parts()[part].load_state_dict(weights)
    return model


@cache
def _frozen_weights() -> dict[str, dict[str, torch.Tensor]]:
    torch.manual_seed(1)
    parts = ExtrapolationModel(tiny_config("zeronvs", image_size=_SIZE)).parts()
    return {part: parts[part].state_dict() for part in ("vae", "image_encoder")}


def _prepare(folder: Path, depth: float = 2.5) -> PreparedData:
    frames = [capture(ring(even(8)), name, depth=depth) for name in ("a", "b")]
    options = PrepConfig(image_size=2 * _SIZE, max_gap_deg=60)
    return prepare(frames, DatasetDepth(), options, test_names={"b"}, folder=folder, progress=False)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> PreparedData:
    prepared = _prepare(tmp_path_factory.mktemp("prepared"))
    encode_with(_model(), [prepared])
    return prepared


def _batch(data: PreparedData, model: ExtrapolationModel, *, cached: bool) -> PairBatch:
    encoder = frame_encoder(model) if cached else None
    reader = ExampleReader([data], "train", model.config.references, encoder)
    packed = TrainingBatches(reader, seed=0)[_POSITIONS]
    assert (packed.image is None) == cached, "what is cached is not read"
    return compute_warp(packed.unpack(), _SIZE)


@pytest.mark.parametrize("family", ["zeronvs", "megascenes", "ours"])
def test_a_step_on_cached_features_is_the_step_on_the_frames(
    data: PreparedData, family: str
) -> None:
    model = _model(family)
    batches = [_batch(data, model, cached=cached) for cached in (False, True)]
    conditions = [model.condition(batch) for batch in batches]
    targets = [
        model.encode_target(batch, condition, StepNoise(torch.Generator().manual_seed(1)))
        for batch, condition in zip(batches, conditions, strict=True)
    ]
    half = {"rtol": 2**-10, "atol": 1e-3}
    torch.testing.assert_close(conditions[1].latents, conditions[0].latents, **half)
    torch.testing.assert_close(conditions[1].embedding, conditions[0].embedding, **half)
    torch.testing.assert_close(targets[1], targets[0], **half)
    losses = [
        float(
            diffusion_loss(model, batch, StepNoise(torch.Generator().manual_seed(2)), 0.1).detach()
        )
        for batch in batches
    ]
    assert losses[1] == pytest.approx(losses[0], rel=1e-3)


def test_a_step_of_zeronvs_asks_no_frozen_network(
    data: PreparedData, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`ours` still encodes its warp, which no two steps share."""
    model = _model("zeronvs")
    batch = _batch(data, model, cached=True)
    asked: list[object] = []
    monkeypatch.setattr(Frozen, "_at", lambda self, image: asked.append(self))
    diffusion_loss(model, batch, StepNoise(torch.Generator().manual_seed(2)), 0.0)
    assert not asked


def test_other_networks_or_frames_have_features_of_their_own(
    data: PreparedData, tmp_path: Path
) -> None:
    def missing(model: ExtrapolationModel, prepared: PreparedData = data) -> list[str]:
        return FeatureFiles(prepared, frame_encoder(model)).missing()

    assert FeatureFiles(data, frame_encoder(_model())).sequences == ["cup/a"]
    assert missing(_model()) == missing(_model("zeronvs")) == []
    for part, name in (("vae", "encoder.conv_in.weight"), ("image_encoder", "logits")):
        changed = _model()
        weights = changed.parts()[part].state_dict()
        next(iter(weights.values()) if name == "logits" else iter([weights[name]])).add_(1e-3)
        assert missing(changed) == ["cup/a"]
    decoder = _model()
    decoder.parts()["vae"].decoder.conv_out.weight.add_(1.0)
    decoder.unet.conv_in.weight.data.add_(1.0)
    assert missing(decoder) == [], "neither the decoder nor the denoiser encodes"
    other = _prepare(tmp_path / "other")
    assert missing(_model(), other) == ["cup/a"]


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    data, model = _prepare(tmp_path / "prepared"), _model("zeronvs")
    encode_with(model, [data])
    files = FeatureFiles(data, frame_encoder(model))
    assert torch.isfinite(files.read("cup/a", 0, 1).target_mean).all()
    latents = next(tmp_path.rglob("latents.npy"))
    content = bytearray(latents.read_bytes())
    content[-9] ^= 1
    latents.write_bytes(content)
    again = FeatureFiles(data, frame_encoder(model))
    with pytest.raises(InputError, match=str(latents.parent)):
        again.read("cup/a", len(data.names("cup/a")) - 1, 0)
    latents.write_bytes(content[:-2])
    assert again.missing() == ["cup/a"]
    encode_with(model, [data])
    assert again.missing() == []


def test_a_missing_cache_is_an_error_unless_the_option_says_otherwise(
    data: PreparedData,
) -> None:
    model, other = _model(), _model()
    other.parts()["vae"].encoder.conv_in.bias.add_(1.0)
    said: list[str] = []

    def encoder(choice: str, of: ExtrapolationModel) -> object:
        trainer = TrainerConfig(latents=choice)
        return cached_encoder(
            TrainConfig(model=of.config, trainer=trainer), of, [data], said.append
        )

    assert encoder("computed", model) is None
    assert not said
    assert encoder("cached", model) == encoder("auto", model) == frame_encoder(model)
    assert len(said) == 2
    assert encoder("auto", other) is None
    assert "computed" in said[-1]
    with pytest.raises(InputError, match=r"trainer\.latents=cached"):
        encoder("cached", other)


def test_the_commands_encode_and_train(
    references: dict[str, Reference],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    torch.save({"state_dict": references["zeronvs"].state}, tmp_path / "zeronvs.ckpt")
    shared = [
        "category=hydrant",
        "model=zeronvs",
        f"model.start={tmp_path / 'zeronvs.ckpt'}",
        *(option.replace("=128", "=64").replace("=256", "=128") for option in TINY_MODEL[:2]),
        *TINY_MODEL[2:],
        "data.train_sequences=1",
        "data.test_sequences=1",
        "data.frames=8",
        "data.image_size=32",
        "prep.max_gap_deg=60",
        "prep.correct=false",
        "prep.max_uses=1",
        "threads=1",
        f"output={tmp_path}",
    ]
    training = [
        "trainer.latents=cached",
        "trainer.steps=1",
        "trainer.batch_size=1",
        "trainer.precision=32-true",
        "validation.examples=1",
        "sampler.steps=1",
        "sampler.guidance=1",
    ]
    monkeypatch.setattr(sys, "argv", ["data_prep", *shared, "workers=1"])
    data_prep.main()
    assert "8 frames encoded" in capsys.readouterr().out
    sizes = [file.stat().st_size for file in tmp_path.rglob("features_64_*/**/*.npy")]
    assert sum(sizes) < 8 * 2 * 2 * (2 * 4 * 8 * 8 + 768) + 500
    monkeypatch.setattr(sys, "argv", ["extrap_train", *shared, *training])
    main()
    assert "encoded before" in capsys.readouterr().out
    run = tmp_path / "train" / "hydrant" / "zeronvs" / "latest"
    assert (run / "summary.json").is_file()
    assert np.isfinite(float((run / "metrics.csv").read_text().splitlines()[-1].split(",")[-1]))
