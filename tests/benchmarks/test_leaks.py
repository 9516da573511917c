"""No method sees what is held out: with every photograph, mask and depth that is no input replaced
by noise, each table's methods generate the same images, bit by bit.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.catalogue import Catalogue
from benchmarks.methods.base import SceneInputs
from benchmarks.protocol import captures
from benchmarks.protocol.captures import Capture
from benchmarks.protocol.prepared_scene import Scene
from benchmarks.run.plan import TableFolder, open_protocol, prepare_draws, selected_draws
from benchmarks.run.run_method import build_method
from extrap_train.config import ModelConfig, TableConfig, UNetConfig
from extrap_train.data.sequences import Frame, FrameSequence
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import save_model
from extrap_train.views import View
from tests.benchmarks.split_folders import write_split
from tests.captures import view_at, write_capture
from tests.posed_folders import write_transforms

TABLES = Catalogue().names("table")


def _kind(name: str) -> tuple[object, ...]:
    """What decides about the way from a table's captures to what its methods are given."""
    content = Catalogue().content("table", name)
    source, depth = content.get("captures", {}).get("source"), content.get("rules", {}).get("depth")
    return source, depth, str(content.get("draws"))


_ONE_OF_A_KIND = list({_kind(name): name for name in TABLES}.values())
_SMALL = ["rules.image_size=16", "rules.views=[3]", "captures.sequences=1"]
_FITTED: dict[str, Any] = {"iterations": 3, "init_points": 40, "max_gaussians": 60}
_FAMILIES = ("ours", "zeronvs", "megascenes")


@dataclass(frozen=True)
class _Noise:
    """Loads noise in the place of a rendered photograph, its depth and its mask."""

    load: Callable[..., View]

    def __call__(self, **wanted: bool) -> View:
        view, random = self.load(**wanted), torch.Generator().manual_seed(0)
        noise = partial(torch.rand, generator=random)
        depth = None if view.depth is None else 1 + noise(view.depth.shape)
        mask = None if view.mask is None else noise(view.mask.shape).round()
        return replace(view, image=noise(view.image.shape), depth=depth, mask=mask)


def _spoilt(frame: Frame) -> Frame:
    """The frame as noise: its files, or where it is rendered what it loads."""
    random = np.random.default_rng(0)
    for file in frame.files:
        with Image.open(file) as picture:
            mode, size = picture.mode, picture.size[::-1]
        if mode == "I;16":  # CO3D's depth: the bits of halves
            values = random.uniform(1, 2, size).astype(np.float16).view(np.uint16)
        else:
            values = random.integers(0, 256, (*size, 3), np.uint8)
        picture = Image.fromarray(values)
        (picture if mode == "I;16" else picture.convert(mode)).save(file)
    return frame if frame.files else replace(frame, load=_Noise(frame.load))


def _table(name: str, tmp_path: Path) -> TableConfig:
    """The table on one small capture of the layout that it reads."""
    catalogue, words = Catalogue(), [*_SMALL, f"output={tmp_path}"]
    source = catalogue.table(name).captures.source
    if source == "reconfusion":
        write_split(tmp_path / "data", 32, 8)
    elif source == "co3d":
        write_capture(tmp_path / "data", ("one",), frames=12, size=32)
        words += ["captures.categories=[cup]"]
    elif source == "folders":
        write_transforms(tmp_path / "data" / "cup" / "one", [view_at(30 * i) for i in range(12)])
        words += ["captures.categories=[cup]"]
    else:
        words += ["captures.categories=[hydrant]", "captures.frames=10", "captures.render_size=32"]
    root = [] if source == "synthetic" else [f"captures.root={tmp_path / 'data'}"]
    return catalogue.table(name, [*words, *root])


def _prepare(table: TableConfig, place: str) -> Scene:
    folder = TableFolder(Path(table.output) / place)
    protocol, opened = open_protocol(table, folder)
    draws = selected_draws(table, protocol, quick=False)
    depth = Catalogue().depth(table.rules.depth)
    (scene,) = prepare_draws(table, folder, draws, opened, depth)
    return scene


@pytest.fixture
def before_and_after(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[TableConfig, SceneInputs, SceneInputs]:
    """What methods are given of a table's draw, and again after all else was spoilt."""
    table = _table(request.param, tmp_path)
    before = _prepare(table, "before")
    find = captures._open

    def spoilt(*arguments: Any) -> list[Capture]:
        return [
            replace(capture, sequence=_without(capture.sequence, before.draw.inputs))
            for capture in find(*arguments)
        ]

    monkeypatch.setattr(captures, "_open", spoilt)
    after = _prepare(table, "after")
    assert after.draw == before.draw
    assert not torch.equal(after.truth().images, before.truth().images)
    return table, before.inputs(), after.inputs()


def _without(sequence: FrameSequence, kept: tuple[str, ...]) -> FrameSequence:
    assert len(sequence.frames) > len(kept)
    frames = [frame if frame.name in kept else _spoilt(frame) for frame in sequence.frames]
    return replace(sequence, frames=tuple(frames))


def _images(table: TableConfig, method: str, options: dict[str, Any], inputs: SceneInputs) -> bytes:
    config = Catalogue().method(method, {**table.options.get(method, {}), **options})
    return build_method(config).synthesize(inputs).images.numpy().tobytes()


@pytest.mark.parametrize("before_and_after", _ONE_OF_A_KIND, indirect=True)
def test_methods_are_given_the_same(
    before_and_after: tuple[TableConfig, SceneInputs, SceneInputs],
) -> None:
    table, before, after = before_and_after
    for old, new in zip(
        (*before.views, *before.fine_views), (*after.views, *after.fine_views), strict=True
    ):
        assert torch.equal(old.image, new.image)
        assert torch.equal(old.depth, new.depth)
        assert torch.equal(old.camera.world_to_cam, new.camera.world_to_cam)
        assert torch.equal(old.camera.intrinsics, new.camera.intrinsics)
    assert torch.equal(before.targets.world_to_cam, after.targets.world_to_cam)
    assert torch.equal(before.targets.intrinsics, after.targets.intrinsics)
    assert (before.category, before.seed) == (after.category, after.seed)
    for method in ("nearest", "inpainted"):
        assert method in table.methods
        assert _images(table, method, {}, before) == _images(table, method, {}, after)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """A tiny model of every family, whose last layer says something."""
    unet = UNetConfig(channels=[16, 32], attention_levels=[False, True], heads=2, token_width=16)
    made = {}
    for family in _FAMILIES:
        config = ModelConfig("tiny", family, image_size=32, octaves=2, unet=unet)
        config.residual = family != "zeronvs"
        torch.manual_seed(0)
        model = ExtrapolationModel(config)
        torch.nn.init.normal_(model.unet.conv_out.weight, std=0.05)
        folder = tmp_path_factory.mktemp(family) / "tiny"
        save_model(model, folder)
        made[family] = str(folder)
    return made


@pytest.mark.slow
@pytest.mark.parametrize("before_and_after", TABLES, indirect=True)
def test_methods_generate_the_same(
    before_and_after: tuple[TableConfig, SceneInputs, SceneInputs], weights: dict[str, str]
) -> None:
    table, before, after = before_and_after
    for method in table.methods:
        known = Catalogue().method(method).options
        options: dict[str, Any] = {"weights": weights[known["family"]]} if "family" in known else {}
        options |= _FITTED if "iterations" in known else {}
        options |= {"hash_levels": 2, "hash_log2_size": 8} if method == "dngaussian" else {}
        options |= {"lora_steps": 2} if "lora_steps" in known else {}
        outcomes = [_outcome(table, method, options, inputs) for inputs in (before, after)]
        assert outcomes[0] == outcomes[1], method
        assert isinstance(outcomes[0], bytes) or not table.rules.is_oracle, outcomes[0]


def _outcome(
    table: TableConfig, method: str, options: dict[str, Any], inputs: SceneInputs
) -> bytes | str:
    """The images, or why there are none: some methods need depth that three inputs may not show."""
    try:
        return _images(table, method, options, inputs)
    except ValueError as error:
        return str(error)
