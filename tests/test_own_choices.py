"""A depth source or a matcher of your own is a module and a YAML in a folder, for any command."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from benchmarks.catalogue import Catalogue
from extrap_train.config import DepthConfig, MonocularConfig, OwnDepthConfig, OwnMatcherConfig
from extrap_train.depth import DepthSource
from extrap_train.depth.sources import depth_source, weight_files
from extrap_train.errors import InputError
from extrap_train.matching.matchers import matcher
from extrap_train.views import Camera, View

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
_FLAT = "defaults: [own_schema, _self_]\nname: flat\nfactory: own_flat.Flat\n"


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setenv("PYTHONPATH", "")
    for group in ("depth", "matcher"):
        (tmp_path / group).mkdir()
    (tmp_path / "own_flat.py").write_text(_DEPTH)
    (tmp_path / "own_still.py").write_text(_MATCHER)
    (tmp_path / "depth" / "flat.yaml").write_text(f"{_FLAT}options: {{distance: 2.5}}\n")
    (tmp_path / "matcher" / "still.yaml").write_text(
        "defaults: [own_schema, _self_]\nname: still\nfactory: own_still.Still\n"
    )
    (tmp_path / "depth" / "mono.yaml").write_text(
        "defaults: [monocular_schema, /matcher@matcher: still, _self_]\nname: mono\n"
    )
    yield tmp_path
    for module in ("own_flat", "own_still"):
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


def test_monocular_depth_takes_a_matcher_from_a_folder(own: Path) -> None:
    config = Catalogue.with_own([str(own)]).depth("mono")
    assert isinstance(config, MonocularConfig)
    assert isinstance(config.matcher, OwnMatcherConfig)
    assert len(matcher(config.matcher).match(torch.zeros(3, 2, 2), torch.zeros(3, 2, 2))) == 1


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
