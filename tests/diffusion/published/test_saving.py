"""A model of published networks is saved for diffusers and transformers, and comes back."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from published_networks import Reference, tiny_config
from transformers import CLIPVisionModelWithProjection

from extrap_train.diffusion.model_files import initial_model, load_model, save_model


def test_plain_diffusers_loads_it_and_so_do_we(
    reference: Reference, checkpoint: Path, tmp_path: Path
) -> None:
    config = tiny_config(reference.family, start=str(checkpoint))
    model = initial_model(config)
    save_model(model, tmp_path / "model")
    outside = {
        "unet": UNet2DConditionModel.from_pretrained(tmp_path / "model" / "unet"),
        "vae": AutoencoderKL.from_pretrained(tmp_path / "model" / "vae"),
        "image_encoder": CLIPVisionModelWithProjection.from_pretrained(
            tmp_path / "model" / "image_encoder"
        ),
    }
    again, started = (
        load_model(tmp_path / "model"),
        initial_model(replace(config, start=str(tmp_path / "model"))),
    )
    for part, network in model.parts().items():
        copies = [again.parts()[part], started.parts()[part], outside.get(part, network)]
        expected = network.state_dict()
        for state in (copy.state_dict() for copy in copies):
            assert state.keys() == expected.keys()
            unlike = [
                name for name, value in expected.items() if not torch.equal(state[name], value)
            ]
            assert not unlike
    schedule = DDIMScheduler.from_pretrained(tmp_path / "model" / "scheduler")
    assert float(schedule.alphas_cumprod[999]) == pytest.approx(0.00466, abs=1e-5)
    assert again.config == config
