"""A saved model keeps its own options; a command's different ones are not lost."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from extrap_train import open_generator
from extrap_train.__main__ import main
from extrap_train.config import ModelConfig
from extrap_train.errors import InputError

_VIEW = [
    "task=view",
    "category=hydrant",
    "scene=synthetic:hydrant/0000",
    "data.frames=6",
    "data.image_size=32",
    "inputs=2",
    "pose=frame000003",
    "trainer.precision=32-true",
]
Command = Callable[..., None]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Command:
    def run(*arguments: str) -> None:
        options = ["extrap_train", *_VIEW, f"output={tmp_path}", *arguments]
        monkeypatch.setattr(sys, "argv", options)
        main()

    return run


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["model.references=1"], "model.references=1: .*ours-hydrant fix model.references=3"),
        (
            ["model.sampler.steps=50"],
            "model.sampler.steps=50: .*=2; give sampler.steps=",
        ),
        (["model.octaves=4", "model.unet.heads=8"], "model.unet.heads=8: .*=4"),
        (["model=small_zeronvs"], "model.family=zeronvs: .*=ours"),
    ],
)
def test_an_option_that_the_weights_contradict_is_refused(
    command: Command, options: list[str], said: str
) -> None:
    for weights in (["weights=ours-hydrant"], []):  # without any: the category's, which is the same
        if not weights and "model=small_zeronvs" in options:
            continue  # has no hydrant
        with pytest.raises(SystemExit) as stopped:
            command(*weights, *options)
        message = str(stopped.value)
        assert message.startswith("error: ")
        assert "\n" not in message
        with pytest.raises(InputError, match=said):
            raise InputError(message)


def test_what_agrees_with_the_weights_is_taken(command: Command, tmp_path: Path) -> None:
    """And what they do not say: where runs lie, and how views are sampled this time."""
    agreeing = ["model=small", "model.references=3", "model.sampler.steps=2", "model.name=small"]
    command("weights=ours-hydrant", *agreeing, "sampler.steps=1")
    assert (tmp_path / "view" / "hydrant-0000" / "truth.png").is_file()


def test_in_python_a_saved_model_is_not_described_again() -> None:
    with pytest.raises(InputError, match="leave config out"):
        open_generator("base", config=ModelConfig(name="other"))
