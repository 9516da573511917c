"""Rows of a diffusion model: what each variant is told, that it repeats, and what it leaves."""

import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.catalogue import Catalogue
from benchmarks.methods import diffusion
from benchmarks.methods.base import Method, SceneInputs, Unavailable
from benchmarks.methods.diffusion import AdaptedDiffusion, Diffusion, _load_cached
from benchmarks.methods.incremental import IncrementalDiffusion
from benchmarks.report.aggregate import read_results
from benchmarks.run.plan import TableFolder
from benchmarks.run.run_method import build_method
from benchmarks.run_table import RunOptions, run_table
from extrap_train.config import ModelConfig, StereoConfig, UNetConfig
from extrap_train.diffusion.generator import DiffusionGenerator
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import save_model
from extrap_train.errors import InputError
from extrap_train.jobs.local import LocalLauncher
from extrap_train.views import View
from tests.benchmarks.analytic import scene_inputs

STEPS = 4
VARIANTS: dict[str, Diffusion] = {
    "ours": Diffusion(),
    "one reference": Diffusion(references=1),
    "adapted": AdaptedDiffusion(lora_steps=STEPS),
    "completed": IncrementalDiffusion(),
}
each_variant = pytest.mark.parametrize("name", VARIANTS)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A tiny model that adds noise of its own to the warp."""
    unet = UNetConfig(channels=[16, 32], attention_levels=[False, True], heads=2, token_width=16)
    config = ModelConfig(name="tiny", image_size=32, octaves=2, unet=unet)
    torch.manual_seed(0)
    model = ExtrapolationModel(config)
    nn.init.normal_(model.unet.conv_out.weight, std=0.05)
    folder = tmp_path_factory.mktemp("weights") / "tiny"
    save_model(model, folder)
    return str(folder)


@pytest.fixture(autouse=True)
def _own_models() -> Iterator[None]:
    """No test sees what another one has left in a model."""
    _load_cached.cache_clear()
    yield
    _load_cached.cache_clear()


@pytest.fixture
def cheap(measured_once: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stereo with few planes, too: what is asked here is the same for any number of them."""
    monkeypatch.setattr(
        "benchmarks.methods.incremental.StereoConfig", partial(StereoConfig, planes=16)
    )


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, list[View], Tensor]]:
    """Every target in the order in which it is generated, the views it is given, and its picture;
    not what only warms the machine up.
    """
    monkeypatch.setattr(Diffusion, "_warm_up", lambda *_: None)
    calls: list[tuple[str, list[View], Tensor]] = []
    generate = DiffusionGenerator.generate

    def spied(self, references, queries, names, seed=0):
        made = generate(self, references, queries, names, seed)
        calls.extend((n, list(references), i) for n, i in zip(names, made.images, strict=True))
        return made

    monkeypatch.setattr(DiffusionGenerator, "generate", spied)
    return calls


def _state(weights: str) -> dict[str, Tensor]:
    return {k: v.clone() for k, v in _load_cached(Path(weights)).state_dict().items()}


def _with_other_photograph(inputs: SceneInputs, index: int) -> SceneInputs:
    def changed(views: tuple[View, ...]) -> tuple[View, ...]:
        other = replace(views[index], image=1 - views[index].image)
        return (*views[:index], other, *views[index + 1 :])

    return replace(inputs, views=changed(inputs.views), fine_views=changed(inputs.fine_views))


def test_its_weight_files_are_also_those_that_a_link_leads_to(weights: str, tmp_path: Path) -> None:
    for part in Path(weights).iterdir():
        (tmp_path / part.name).symlink_to(part)
    files = Diffusion(weights=str(tmp_path)).weight_files("analytic")
    assert tmp_path / "unet" / "diffusion_pytorch_model.safetensors" in files


@each_variant
def test_weights_of_another_family_are_refused_before_anything_runs(
    name: str, weights: str
) -> None:
    method = replace(VARIANTS[name], family="zeronvs", weights=weights, references=None)
    with pytest.raises(InputError, match="is a model of the family ours; give weights of zeronvs"):
        method.weight_files("analytic")


@pytest.mark.usefixtures("cheap")
@each_variant
def test_it_generates_the_targets_and_repeats_itself(name: str, weights: str) -> None:
    inputs, truth = scene_inputs(size=40)  # other than the model's: it is resampled
    method = replace(VARIANTS[name], weights=weights)
    assert isinstance(method, Method)
    assert method.weight_files("analytic")
    made = method.synthesize(inputs)
    assert made.images.shape == truth.shape
    assert made.images.min() >= 0
    assert made.images.max() <= 1
    assert made.seconds > 0
    assert made.given["weights"] == "tiny"
    assert made.given["made at"] == "32 px"
    _load_cached.cache_clear()
    torch.manual_seed(5)
    assert torch.equal(method.synthesize(inputs).images, made.images)


def test_one_reference_is_the_nearest_input(weights: str) -> None:
    inputs, _ = scene_inputs((0.0, 40.0, 80.0), (10.0, 70.0))
    method = Diffusion(weights=weights, references=1)
    made = method.synthesize(inputs)
    assert made.given["references"] == "the nearest 1"
    far = _with_other_photograph(inputs, 1)
    assert torch.equal(method.synthesize(far).images, made.images)
    fused = Diffusion(weights=weights)
    assert not torch.equal(fused.synthesize(far).images, fused.synthesize(inputs).images)
    near = _with_other_photograph(inputs, 0)
    changed = (method.synthesize(near).images - made.images).abs().amax((1, 2, 3))
    assert changed[0] > 0.1
    assert changed[1] == 0


@pytest.mark.usefixtures("cheap")
def test_an_adapter_is_its_scenes_alone(weights: str) -> None:
    """An earlier scene changes neither the model nor what another scene is adapted to."""
    one, _ = scene_inputs((0.0, 40.0, 80.0))
    other, _ = scene_inputs((100.0, 130.0, 150.0), (110.0, 140.0))
    method = AdaptedDiffusion(weights=weights, lora_steps=STEPS)
    alone = method.synthesize(other)
    assert alone.counts["kept_step"] > 0
    _load_cached.cache_clear()
    plain = Diffusion(weights=weights).synthesize(one)
    before = _state(weights)
    first = method.synthesize(one)
    assert first.counts["adaptation_steps"] == STEPS
    assert first.given["adaptation ended by"] == "steps"
    assert first.counts["kept_step"] > 0
    assert not torch.equal(first.images, plain.images)
    after = _load_cached(Path(weights)).state_dict()
    assert list(after) == list(before)
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert not any(p.requires_grad for p in _load_cached(Path(weights)).parameters())
    assert torch.equal(method.synthesize(other).images, alone.images)
    assert torch.equal(Diffusion(weights=weights).synthesize(one).images, plain.images)


def test_an_adapter_goes_even_where_adapting_fails(
    weights: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("no luck")

    monkeypatch.setattr(diffusion, "adapt", fail)
    before = _state(weights)
    with pytest.raises(RuntimeError, match="no luck"):
        AdaptedDiffusion(weights=weights).synthesize(scene_inputs()[0])
    assert list(_load_cached(Path(weights)).state_dict()) == list(before)


def test_time_is_a_limit_that_the_row_tells_of(weights: str) -> None:
    method = AdaptedDiffusion(weights=weights, lora_steps=100_000, lora_minutes=0.001)
    made = method.synthesize(scene_inputs()[0])
    assert made.given["adaptation ended by"] == "time"
    assert made.counts["adaptation_steps"] < 100_000


def test_what_a_process_does_once_is_not_a_cells_time(
    weights: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first picture compiles; a later one could not be told from it by its time."""
    inputs, _ = scene_inputs(size=32)
    generate, calls = DiffusionGenerator.generate, []

    def slow_at_first(self, references, queries, names, seed=0):
        calls.append(names)
        if len(calls) == 1:
            time.sleep(2)
        return generate(self, references, queries, names, seed)

    monkeypatch.setattr(DiffusionGenerator, "generate", slow_at_first)
    assert Diffusion(weights=weights).synthesize(inputs).seconds * len(calls[0]) < 2
    assert len(calls) == 2


@pytest.mark.usefixtures("cheap")
def test_what_is_generated_is_a_reference_for_the_next(
    weights: str, asked: list[tuple[str, list[View], Tensor]]
) -> None:
    """The nearer target comes first; beside the inputs, only what was generated is ever seen."""
    inputs, _ = scene_inputs((0.0, 20.0, 40.0), (95.0, 65.0))
    made = IncrementalDiffusion(weights=weights).synthesize(inputs)
    order = list(dict.fromkeys(name for name, _, _ in asked))
    assert order == ["target 1", "target 0"]
    assert made.counts["pictures"] == len(asked)
    photographs = {view.name: view.image for view in inputs.fine_views}
    generated: list[Tensor] = []
    for name, references, picture in asked:
        for view in references:
            if view.name in photographs:
                error = (view.image - photographs[view.name]).abs().max()
                assert error <= 0.5 / 255 + 1e-6
                continue
            assert (name, view.name) == ("target 0", "target 1")
            assert any(torch.equal(view.image, before) for before in generated)
        if name == "target 1":
            assert {view.name for view in references} == set(photographs)
            larger = functional.interpolate(picture[None], (64, 64), mode="bicubic")[0]
            generated.append((larger.clamp(0, 1) * 255).round() / 255)
    assert asked[-1][1][0].name == "target 1"
    for index, image in enumerate(made.images):
        assert any(torch.equal(image, i) for name, _, i in asked if name == f"target {index}")


def test_the_loops_points_lie_in_the_photographs_world(weights: str) -> None:
    """On the ball or on the wall of the round room, whose radii are 0.6 and 4; the map's are a
    third of it.
    """
    inputs, _ = scene_inputs((0.0, 20.0, 40.0), (60.0,))
    points = IncrementalDiffusion(weights=weights).synthesize(inputs).points
    assert points is not None
    radii = points.norm(dim=-1)
    off = torch.minimum((radii / 0.6 - 1).abs(), (radii / 4 - 1).abs())
    assert (off < 0.02).float().mean() > 0.9


@each_variant
def test_missing_weights_say_how_to_make_them(name: str) -> None:
    with pytest.raises(Unavailable, match=r"ours-analytic .*python -m extrap_train category="):
        VARIANTS[name].weight_files("analytic")
    with pytest.raises(Unavailable, match=r"options.METHOD.weights=FOLDER"):
        VARIANTS[name].synthesize(scene_inputs()[0])


@pytest.mark.parametrize(
    "options",
    [
        {"references": 0},
        {"references": 2, "family": "zeronvs"},
        {"family": "theirs"},
        {"steps": -1},
        {"lora_steps": 0},
        {"lora_minutes": 0.0},
        {"lora_minutes": float("nan")},
    ],
)
def test_an_option_that_cannot_be_meant_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(options))):
        build_method(Catalogue().method("ours_lora", options))


@pytest.mark.slow
def test_the_ablations_rows_run_as_their_files_say(
    fork_server: ForkServerContext, weights: str, tmp_path: Path
) -> None:
    catalogue = Catalogue.with_own()
    small = ["captures.frames=10", "captures.render_size=32", "rules.image_size=32"]
    scoring = ["scoring.dists=false", "scoring.lpips=[]", "columns=[psnr]", "rules.views=[6]"]
    rows = catalogue.table("ablation").methods
    base = shutil.copytree(weights, tmp_path / "base")
    folders = dict.fromkeys(rows, weights) | {"ours_base": base}
    tiny = [f"options.{name}.weights={folder}" for name, folder in folders.items()]
    words = [*small, *scoring, *tiny, "options.ours_lora.lora_steps=2", f"output={tmp_path}"]
    table = catalogue.table("ablation", words)
    assert run_table(table, catalogue, RunOptions(quick=True, launcher=LocalLauncher(1))) == 0
    cells = {cell.method: cell for cell in read_results(TableFolder(tmp_path / "ablation")).cells}
    assert list(cells) == rows
    assert {cell.status for cell in cells.values()} == {"ok"}
    assert cells["ours_lora"].counts["adaptation_steps"] == 2
    assert cells["ours_completed"].metrics["f_score"].value is not None
    pictures = {name: tuple(cell.images.values()) for name, cell in cells.items()}
    assert pictures["ours"] == pictures["ours_base"]  # a copy of the same tiny model
    assert len(set(pictures.values())) >= 3
