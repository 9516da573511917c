"""Splats of a map: fitted anew exactly when what they are fitted to changes."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from extrap_train.config import SplatsConfig
from extrap_train.gaussians.fit import Diverged
from extrap_train.gaussians.ply import read_splats
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.reconstruction.global_map import GlobalMap, Origin
from extrap_train.tasks import splats as task
from tests.benchmarks.analytic import view_at

_UNIT = WorldFrame(torch.tensor([3.0, -2.0, 5.0]), 7.0)
_OPTIONS = SplatsConfig(iterations=20, count=300)


def _known(size: int = 24) -> GlobalMap:
    known = GlobalMap(0.01)
    for azimuth_deg in (0.0, 40.0, 80.0):
        view = view_at(azimuth_deg, size)
        known, _ = known.added(view, torch.ones(size, size), Origin("given", 0))
    return known


def test_they_lie_where_the_views_depth_does_in_the_photographs_world(tmp_path: Path) -> None:
    options = SplatsConfig(iterations=60, count=800)
    found = task.write_fitted_splats(_known(), _UNIT, options, 0, tmp_path)
    means = (read_splats(tmp_path / "splats.ply").means - _UNIT.center) / _UNIT.unit
    radius = means.norm(dim=1)
    off_surface = torch.minimum((radius - 0.6).abs(), (radius - 4.0).abs())  # the ball, the room
    assert off_surface.median() < 0.05
    assert found["psnr"] > 16


@pytest.mark.parametrize("changed", ["nothing", "options", "seed", "view", "cut off"])
def test_they_are_fitted_anew_when_something_changed(tmp_path: Path, changed: str) -> None:
    known, options, seed = _known(), _OPTIONS, 0
    task.write_fitted_splats(known, _UNIT, options, seed, tmp_path)
    match changed:
        case "options":
            options = replace(options, iterations=21)
        case "seed":
            seed = 1
        case "view":
            last = known.views[-1]
            darker = replace(last, view=replace(last.view, image=last.view.image * 0.9))
            known = replace(known, views=(*known.views[:-1], darker))
        case "cut off":
            file = tmp_path / "splats.ply"
            file.write_bytes(file.read_bytes()[:-9])
    again = task.write_fitted_splats(known, _UNIT, options, seed, tmp_path)
    assert (again["seconds"] == 0) == (changed == "nothing")


def test_a_fit_that_diverges_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverges(*_: object) -> None:
        raise Diverged("the loss became nan")

    monkeypatch.setattr(task, "fit_views", diverges)
    with pytest.raises(Diverged):
        task.write_fitted_splats(_known(), _UNIT, _OPTIONS, 0, tmp_path)
    assert not list(tmp_path.iterdir())
