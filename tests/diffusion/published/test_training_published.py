"""A published checkpoint trains for a few steps, is saved, comes back and generates a view.

`_trains` takes the model's loss and the optimiser in a loop of its own: no Trainer, no averaged
weights, no warm-up. The last test has these: it gives the tiny network to the real task.

The full size takes 17 GiB and some minutes: `pytest -m slow tests/diffusion/published`.
"""

import json
import resource
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from published_networks import TINY_MODEL, Reference, configured, tiny_config

from benchmarks.perf import diffusion_case
from extrap_train.__main__ import main
from extrap_train.config import ModelConfig, SamplerConfig, TrainConfig, TrainerConfig
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.model_files import initial_model, load_model, save_model
from extrap_train.diffusion.sampler import sample_views
from extrap_train.diffusion.step_noise import StepNoise
from extrap_train.diffusion.training import CategoryTraining

_STEPS = 2


def _trains(config: ModelConfig, folder: Path, *, mixed: bool) -> None:
    """`mixed` computes in bfloat16, which is slow on processors without units for it."""
    model = initial_model(config)
    model.unet.train().enable_gradient_checkpointing()
    options = TrainerConfig(warmup_steps=0, ema_decay=0.0)
    training = CategoryTraining(model, TrainConfig(model=config, trainer=options), [], None)
    optimizer = training.configure_optimizers()["optimizer"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diffusion_case, "IMAGE_SIZE", config.image_size)
        batch = diffusion_case.batch_of(1, torch.device("cpu"))
    frozen = [model.parts()[part] for part in ("vae", "image_encoder")]
    sums = {name: _sums(x) for name, x in model.named_parameters()}
    frozen_sums = [_sums(x) for network in frozen for x in network.parameters()]
    for step in range(_STEPS):
        with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
            loss = diffusion_loss(model, batch, StepNoise(torch.Generator().manual_seed(step)), 0.0)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        assert loss.isfinite()
    # Queries and keys of the attention to the one token learn nothing; weight decay moves them.
    still = [name for name, x in model.named_parameters() if _sums(x) == sums[name]]
    assert not still
    assert frozen_sums == [_sums(x) for network in frozen for x in network.parameters()]
    del optimizer, training
    save_model(model, folder / "model")
    trained = model.unet.conv_in.weight.detach().clone()
    del model
    again = load_model(folder / "model").eval()
    assert torch.equal(again.unet.conv_in.weight, trained)
    options_of_sampling = SamplerConfig(steps=2, guidance=3.0)
    image = sample_views(again, batch, options_of_sampling, ["view"])
    assert image.shape == batch.image.shape
    assert image.isfinite().all()


def _sums(tensor: torch.Tensor) -> tuple[float, float]:
    exact = tensor.detach().double()
    return float(exact.sum()), float(exact.square().sum())


def test_a_tiny_one(references: dict[str, Reference], tmp_path: Path) -> None:
    torch.save({"state_dict": references["zeronvs"].state}, tmp_path / "zeronvs.ckpt")
    start = str(tmp_path / "zeronvs.ckpt")
    _trains(tiny_config("zeronvs", image_size=128, start=start), tmp_path, mixed=False)


@pytest.mark.slow
def test_the_full_size_within_20_gib(shared: Path, seeded, tmp_path: Path) -> None:
    layout = json.loads((shared / "layouts" / "zeronvs_full.json").read_text())["keys"]
    names = {name: shape for name, shape in layout.items() if not name.startswith("model_ema")}
    state = {name: seeded({name: shape})[name].half() for name, shape in names.items()}
    torch.save({"state_dict": state}, tmp_path / "zeronvs.ckpt")
    del state
    start = str(tmp_path / "zeronvs.ckpt")
    _trains(replace(configured("zeronvs"), start=start), tmp_path, mixed=True)
    peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak resident memory: {peak_gib:.1f} GiB")
    assert peak_gib < 20


def test_the_task_trains_a_tiny_one_with_average_and_warm_up(
    references: dict[str, Reference], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is saved is the average, with the decay 2/11 that it has at its second step."""
    state = references["zeronvs"].state
    torch.save({"state_dict": state}, tmp_path / "zeronvs.ckpt")
    options = [
        "category=hydrant",
        "model=zeronvs",
        f"model.start={tmp_path / 'zeronvs.ckpt'}",
        *TINY_MODEL,
        "data.train_sequences=1",
        "data.test_sequences=1",
        "data.frames=12",
        "data.image_size=32",
        "prep.max_gap_deg=60",
        "prep.correct=false",
        "prep.max_uses=1",
        "trainer.batch_size=1",
        "trainer.warmup_steps=2",
        "trainer.checkpoint_every=1",
        "trainer.validate_every=1",
        "trainer.precision=32-true",
        "validation.examples=1",
        "sampler.steps=1",
        "sampler.guidance=1",
        "threads=1",
        f"output={tmp_path}",
    ]
    run = tmp_path / "train" / "hydrant" / "zeronvs" / "latest"
    checkpoints = []
    for step in (1, 2):  # a finished run keeps the last of its checkpoints
        monkeypatch.setattr(sys, "argv", ["extrap_train", *options, f"trainer.steps={step}"])
        main()
        assert json.loads((run / "summary.json").read_text())["steps"] == step
        file = run / "checkpoints" / f"step-0000000{step}.ckpt"
        checkpoints.append(torch.load(file, weights_only=True))
    first, second = checkpoints
    name = "model.unet.conv_out.weight"
    start = state["model.diffusion_model.out.2.weight"]
    trained = [checkpoint["current_model_state"][name] for checkpoint in (first, second)]
    averaged = [checkpoint["state_dict"][name] for checkpoint in (first, second)]
    moved = float((trained[0] - start).abs().max())
    assert moved == pytest.approx(0.5e-4, rel=0.05)  # Adam's first step, at half the rate
    expected = averaged[0].lerp(trained[1], 9 / 11)
    torch.testing.assert_close(averaged[1], expected, atol=1e-8, rtol=0)
    assert not torch.equal(averaged[1], trained[1])
    assert torch.equal(load_model(run / "model").unet.conv_out.weight, averaged[1])
