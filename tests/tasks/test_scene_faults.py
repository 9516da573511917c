"""What goes wrong while a scene is generated or adapted to is one line that says what to turn."""

import json
import math
import shutil
from pathlib import Path

import hydra
import pytest
import torch

from extrap_train.cli import register_schemas, typed_config
from extrap_train.diffusion.generator import sample_views
from extrap_train.diffusion.model_files import load_model, save_model
from extrap_train.errors import InputError
from extrap_train.store.records import write_summary

_VIEW = ["task=view", "pose=frame000003"]
_SHORT = ["task=scene", "minutes=0.2", "lora.steps=2", "lora.validate_every=2"]


@pytest.fixture
def broken(weights: Path, tmp_path: Path) -> Path:
    """Weights as a training that diverged leaves them."""
    folder = Path(shutil.copytree(weights, tmp_path / "nan"))
    model = load_model(folder)
    torch.nn.init.constant_(model.unet.conv_out.bias, math.nan)
    save_model(model, folder)
    return folder


@pytest.mark.parametrize("task", [_VIEW, _SHORT, [*_SHORT, "inputs=null"]])
def test_pictures_that_are_no_numbers_are_not_delivered(refused, broken, tmp_path, task) -> None:
    said = refused(*task, f"weights={broken}")
    assert "not finite" in said
    assert "give other weights=" in said
    assert not (tmp_path / task[0].removeprefix("task=") / "hydrant-0000").exists()


def test_a_summary_has_no_nan_wherever_it_stands(tmp_path) -> None:
    write_summary(tmp_path, {"losses": [(0, math.nan), (1, 0.5)], "psnr": {"all": math.nan}})
    found = json.loads((tmp_path / "summary.json").read_text())
    assert found == {"losses": [[0, None], [1, 0.5]], "psnr": {"all": None}}


def test_memory_that_ends_in_generation_is_one_line(
    command, refused, weights, tmp_path, monkeypatch
) -> None:
    """Two views at a time fit."""

    def sampled(model, batch, *rest):
        if len(batch.camera.world_to_cam) > 2:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return sample_views(model, batch, *rest)

    monkeypatch.setattr("extrap_train.diffusion.generator.sample_views", sampled)
    walk = ["task=view", f"weights={weights}", "orbit=90", "frames=3"]
    assert "give sample_batch_size=8" in refused(*walk)
    assert "give sample_batch_size=8" in refused(*_SHORT, f"weights={weights}")
    command(*walk, "sample_batch_size=2")
    assert len(list((tmp_path / "view" / "hydrant-0000" / "views").iterdir())) == 6


def test_memory_that_ends_in_adapting_is_one_line(refused, weights, monkeypatch) -> None:
    checkpointing = []

    def loss(model, *_: object, **__: object) -> None:
        checkpointing.append(model.unet.is_gradient_checkpointing)
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr("extrap_train.diffusion.adaptation.diffusion_loss", loss)
    adapt = [*_SHORT, f"weights={weights}", "inputs=null", "lora.batch_size=2"]
    said = refused(*adapt)
    assert "out of memory at lora.batch_size=2" in said
    assert "give trainer.gradient_checkpointing=true or lora.batch_size=1" in said
    said = refused(*adapt, "trainer.gradient_checkpointing=true")
    assert "give lora.batch_size=1 or lora.convolutions=false" in said
    assert checkpointing == [False, True]


def test_what_adapting_cannot_do_is_refused(refused, weights) -> None:
    assert "task=scene trains for minutes" in refused(
        *_SHORT, f"weights={weights}", "trainer.compile=true"
    )


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("task", [_VIEW, _SHORT, ["task=category"]])
def test_a_gpu_that_there_is_not_is_one_line(refused, weights, task) -> None:
    said = refused(*task, f"weights={weights}", "trainer.accelerator=gpu")
    assert "trainer.accelerator=gpu: torch" in said
    assert "give trainer.accelerator=auto or cpu" in said


def test_the_size_of_pairs_is_asked_for_where_pairs_are_prepared_alone() -> None:
    register_schemas()
    with hydra.initialize_config_module("conf", version_base="1.3"):
        options = ["category=cup", "model=zeronvs", "prep.image_size=128"]
        view, category = (
            hydra.compose("train", [*options, f"task={task}"]) for task in ("view", "category")
        )
    typed_config(view)
    with pytest.raises(InputError, match=r"prep\.image_size=128, but warps are made at"):
        typed_config(category)
