"""A depth source, a matcher or a metric of your own is a module and a YAML in a folder."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from benchmarks.catalogue import Catalogue
from benchmarks.protocol.prepared_scene import Truth
from benchmarks.run.identity import scores_manifest, sources_digest
from benchmarks.score import scoring
from benchmarks.score.scoring import score_images
from extrap_train.config import (
    DepthConfig,
    MonocularConfig,
    OwnDepthConfig,
    OwnMatcherConfig,
    metric_direction,
)
from extrap_train.depth import DepthSource
from extrap_train.depth.files import FilesDepth
from extrap_train.depth.sources import depth_source, weight_files
from extrap_train.errors import InputError
from extrap_train.matching.matchers import matcher
from extrap_train.views import Camera, View, stack_cameras

_DEPTH = """
from dataclasses import dataclass

import torch

from extrap_train.depth import DepthMap, point_maps_of


@dataclass(frozen=True)
class Flat:
    distance: float = 3.0
    weights: str = ""
    image_size: int | None = None

    def depth_map(self, view, neighbours):
        depth = torch.full_like(view.image[0], self.distance)
        return DepthMap(depth, torch.ones_like(depth))

    def depth_maps(self, views):
        return [self.depth_map(view, ()) for view in views]

    def point_maps(self, first, second):
        return point_maps_of(first, self.depth_map(first, ()), second, self.depth_map(second, ()))


class Half:
    image_size = None
"""
_MATCHER = """
import torch

from extrap_train.matching import Matches


class Still:
    def match(self, first, second, first_known=None):
        corner = torch.tensor([[0.5, 0.5]])
        return Matches(corner, corner, torch.ones(1))
"""
_METRIC = """
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Brightness:
    power: float = 1.0

    def score(self, images, truth):
        return (images**self.power).mean((1, 2, 3))


class Single:
    def score(self, images, truth):
        return torch.tensor(0.5)
"""
_FLAT = "defaults: [own_schema, _self_]\nname: flat\nfactory: own_flat.Flat\n"


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setenv("PYTHONPATH", "")
    # Its SSIM imports for seconds at its first call, and nothing here is about it.
    monkeypatch.setattr(scoring, "megascenes_compat", lambda *_: {})
    for group in ("depth", "matcher", "metric"):
        (tmp_path / group).mkdir()
    (tmp_path / "own_flat.py").write_text(_DEPTH)
    (tmp_path / "own_still.py").write_text(_MATCHER)
    (tmp_path / "own_bright.py").write_text(_METRIC)
    (tmp_path / "metric" / "bright.yaml").write_text(
        "factory: own_bright.Brightness\nbetter: lower\noptions: {power: 2.0}\n"
    )
    (tmp_path / "depth" / "flat.yaml").write_text(f"{_FLAT}options: {{distance: 2.5}}\n")
    (tmp_path / "matcher" / "still.yaml").write_text(
        "defaults: [own_schema, _self_]\nname: still\nfactory: own_still.Still\n"
    )
    (tmp_path / "depth" / "mono.yaml").write_text(
        "defaults: [monocular_schema, /matcher@matcher: still, _self_]\nname: mono\n"
    )
    yield tmp_path
    for module in ("own_flat", "own_still", "own_bright"):
        sys.modules.pop(module, None)


def _view() -> View:
    return View(torch.zeros(3, 2, 2), Camera(torch.eye(4), torch.eye(3), 2, 2))


def test_a_table_takes_a_depth_source_from_a_folder(own: Path) -> None:
    catalogue = Catalogue.with_own([str(own)])
    catalogue.check(catalogue.table("table1", ["rules.depth=flat"]))
    with pytest.raises(InputError, match=r"rules\.depth"):
        Catalogue().check(Catalogue().table("table1", ["rules.depth=flat"]))
    config = catalogue.depth("flat")
    source = depth_source(config)
    assert isinstance(source, DepthSource)
    assert source.depth_map(_view(), []).depth.unique().item() == 2.5
    assert [path.name for path in weight_files(config)] == ["own_flat.py"]


def test_a_table_knows_the_data_sets_depth_by_one_name(own: Path) -> None:
    """By another one, the table would not be marked as an oracle."""
    (own / "depth" / "truth.yaml").write_text("defaults: [dataset_schema, _self_]\nname: truth\n")
    with pytest.raises(InputError, match=r"rules\.depth=dataset"):
        Catalogue.with_own([str(own)]).depth("truth")
    assert Catalogue().depth("dataset").name == "dataset"


def test_monocular_depth_takes_a_matcher_from_a_folder(own: Path) -> None:
    config = Catalogue.with_own([str(own)]).depth("mono")
    assert isinstance(config, MonocularConfig)
    assert isinstance(config.matcher, OwnMatcherConfig)
    assert len(matcher(config.matcher).match(torch.zeros(3, 2, 2), torch.zeros(3, 2, 2))) == 1


def test_a_table_takes_depth_from_files(own: Path) -> None:
    content = "defaults: [files_schema, /matcher@matcher: flow, _self_]\nname: ready\nfolder: {}\n"
    (own / "a.npz").touch()
    (own / "depth" / "ready.yaml").write_text(content.format(own))
    assert isinstance(depth_source(Catalogue.with_own([str(own)]).depth("ready")), FilesDepth)


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (OwnDepthConfig(factory="own_flat.Nothing"), "factory own_flat.Nothing"),
        (OwnDepthConfig(factory="nowhere.Flat"), "factory nowhere.Flat"),
        (OwnDepthConfig(factory="Flat"), "factory Flat"),
        (OwnDepthConfig(factory="own_flat.Half"), "depth_map"),
        (OwnDepthConfig(factory="own_flat.Flat", options={"far": 1.0}), "no option far"),
        (OwnDepthConfig(factory="own_flat.Flat", options={"distance": "far"}), "options.distance"),
    ],
)
def test_what_does_not_fit_is_one_line(own: Path, config: DepthConfig, said: str) -> None:
    Catalogue.with_own([str(own)])
    with pytest.raises(InputError) as error:
        depth_source(config)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_that_an_option_names_decides_about_the_depth(own: Path, tmp_path: Path) -> None:
    Catalogue.with_own([str(own)])
    (tmp_path / "flat.pt").write_bytes(b"weights")
    options = {"weights": str(tmp_path / "flat.pt")}
    found = weight_files(OwnDepthConfig(factory="own_flat.Flat", options=options))
    assert [path.name for path in found] == ["own_flat.py", "flat.pt"]


def _truth() -> Truth:
    cameras = stack_cameras([_view().camera])
    image, mask = torch.full((1, 3, 16, 16), 0.5), torch.ones(1, 16, 16)
    return Truth(image, cameras, warps=image, masks=mask, depths=None, surface=None)


def test_a_table_takes_a_metric_from_a_folder(own: Path) -> None:
    """Beside the package's metrics, with its options, direction and identity."""
    catalogue = Catalogue.with_own([str(own)])
    words = ["scoring.metrics=[bright]", "columns=[psnr,bright]", "scoring.lpips=[]"]
    table = catalogue.table("table1", [*words, "scoring.dists=false"])
    catalogue.check(table)
    options = table.scoring
    assert metric_direction("bright", options.own) == -1
    assert metric_direction("psnr", options.own) == 1
    scores = score_images(torch.full((1, 3, 16, 16), 0.5), _truth(), options)
    assert scores["bright"].value == pytest.approx(0.25)
    assert {"psnr", "ssim"} <= scores.keys()
    before = scores_manifest(options)
    sources_digest.cache_clear()
    (own / "own_bright.py").write_text(_METRIC + "\n")
    assert scores_manifest(options).inputs != before.inputs
    assert scores_manifest(options).options == before.options


@pytest.mark.parametrize(
    ("yaml", "said"),
    [
        ("factory: own_bright.Brightness\nbetter: upwards\n", "better"),
        ("better: lower\n", "factory"),
        ("factory: own_bright.Brightness\nworse: 1\n", "worse"),
        ("factory: own_bright.Single\n", "one number per image"),
        ("factory: own_bright.Dark\n", "factory own_bright.Dark"),
        ("factory: own_flat.Flat\n", "score"),
    ],
)
def test_a_metric_that_does_not_fit_is_one_line(own: Path, yaml: str, said: str) -> None:
    (own / "metric" / "odd.yaml").write_text(yaml)
    catalogue = Catalogue.with_own([str(own)])
    words = ["scoring.metrics=[odd]", "scoring.lpips=[]", "scoring.dists=false"]
    truth = _truth()
    with pytest.raises(InputError) as error:
        score_images(truth.images, truth, catalogue.table("table1", words).scoring)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_metric_does_not_take_the_place_of_the_packages(own: Path) -> None:
    (own / "metric" / "psnr.yaml").write_text("factory: own_bright.Brightness\n")
    catalogue = Catalogue.with_own([str(own)])
    with pytest.raises(InputError, match=r"scoring\.metrics: psnr"):
        catalogue.table("table1", ["scoring.metrics=[psnr]"])
    with pytest.raises(InputError, match="columns"):
        catalogue.check(catalogue.table("table1", ["columns=[bright]"]))
