"""A published checkpoint trains for a few steps, is saved, comes back and paints a view.

The full size takes 17 GiB and some minutes: `pytest -m slow tests/diffusion/published`.
"""

import json
import resource
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from published_networks import Reference, configured, tiny_config

from benchmarks.perf.diffusion_case import batch_of
from extrap_train.config import ModelConfig, SamplerConfig, TrainConfig, TrainerConfig
from extrap_train.diffusion.checkpoint import initial_model, load_model, save_model
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.sampler import sample_views, view_generator
from extrap_train.diffusion.training import CategoryTraining

_STEPS = 3


def _trains(config: ModelConfig, folder: Path) -> None:
    model = initial_model(config)
    model.unet.train().enable_gradient_checkpointing()
    options = TrainerConfig(warmup_steps=0, ema_decay=0.0)
    training = CategoryTraining(model, TrainConfig(model=config, trainer=options), [], None)
    optimizer = training.configure_optimizers()["optimizer"]
    batch = batch_of(1, torch.device("cpu"))
    frozen = [model.parts()[part] for part in ("vae", "image_encoder")]
    sums = {name: _sums(x) for name, x in model.named_parameters()}
    frozen_sums = [_sums(x) for network in frozen for x in network.parameters()]
    for step in range(_STEPS):
        with torch.autocast("cpu", torch.bfloat16):
            loss = diffusion_loss(model, batch, torch.Generator().manual_seed(step), 0.0)
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
    image = sample_views(again, batch, options_of_sampling, [view_generator(0, "view")])
    assert image.shape == (1, 3, 256, 256)
    assert image.isfinite().all()


def _sums(tensor: torch.Tensor) -> tuple[float, float]:
    exact = tensor.detach().double()
    return float(exact.sum()), float(exact.square().sum())


def test_a_tiny_one(references: dict[str, Reference], tmp_path: Path) -> None:
    torch.save({"state_dict": references["zeronvs"].state}, tmp_path / "zeronvs.ckpt")
    _trains(tiny_config("zeronvs", start=str(tmp_path / "zeronvs.ckpt")), tmp_path)


@pytest.mark.slow
def test_the_full_size_within_20_gib(shared: Path, seeded, tmp_path: Path) -> None:
    layout = json.loads((shared / "layouts" / "zeronvs_full.json").read_text())["keys"]
    names = {name: shape for name, shape in layout.items() if not name.startswith("model_ema")}
    state = {name: seeded({name: shape})[name].half() for name, shape in names.items()}
    torch.save({"state_dict": state}, tmp_path / "zeronvs.ckpt")
    del state
    start = str(tmp_path / "zeronvs.ckpt")
    _trains(replace(configured("zeronvs"), start=start), tmp_path)
    peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak resident memory: {peak_gib:.1f} GiB")
    assert peak_gib < 20
