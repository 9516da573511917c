"""One scene on the command line: a tiny model, and the commands that work on the scene with it."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from extrap_train.__main__ import main
from extrap_train.config import ModelConfig, UNetConfig
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import save_model

_UNET = UNetConfig(channels=[16, 32], attention_levels=[False, True], heads=2, token_width=16)
_TINY = ModelConfig(name="tiny", image_size=16, octaves=2, unet=_UNET)
_SCENE = ["scene=synthetic:hydrant/0000", "data.frames=8", "data.image_size=32", "inputs=4"]

Command = Callable[..., None]
Refused = Callable[..., str]


@pytest.fixture(autouse=True, scope="module")
def _rendered_once(rendered_once: None) -> None:
    """See `rendered_once`."""


@pytest.fixture(autouse=True, scope="module")
def _coarse_results(coarse_results: None) -> None:
    """See `coarse_results`."""


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    model = ExtrapolationModel(_TINY)
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.05)
    folder = tmp_path_factory.mktemp("weights") / "model"
    save_model(model, folder)
    return folder


@pytest.fixture
def brief(measured_once: None, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Options of an adaptation that is over at once and draws no curve."""
    monkeypatch.setattr("extrap_train.tasks.scene.plot_curve", lambda *_: None)
    few = ["lora.batch_size=1", "lora.virtual_references=2", "validation.examples=1"]
    return ["minutes=0.2", "lora.steps=1", "lora.validate_every=1", "sampler.steps=1", *few]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Command:
    def run(*arguments: str) -> None:
        options = ["category=hydrant", *_SCENE, f"output={tmp_path}", "trainer.precision=32-true"]
        monkeypatch.setattr(sys, "argv", ["extrap_train", *options, *arguments])
        main()

    return run


@pytest.fixture
def refused(command: Command) -> Refused:
    """The one line that a command ends with."""

    def run(*arguments: str) -> str:
        with pytest.raises(SystemExit) as stopped:
            command(*arguments)
        message = str(stopped.value)
        assert message.startswith("error: ")
        assert "\n" not in message
        return message

    return run
