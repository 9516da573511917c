"""The growing cloud in a real browser: it connects, draws, and its sliders choose what is shown."""

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import scenes
import torch
from headless import headless_page
from PIL import Image

from extrap_train.reconstruction.global_map import (
    GENERATED,
    GIVEN,
    GlobalMap,
    MapView,
    Origin,
)
from extrap_train.reconstruction.viewer import CloudViewer
from extrap_train.views import View

_SIZE = 48
_SCENE = scenes.Scene((scenes.sphere(0.6), scenes.plane(0.6, (0.0, 1.0, 0.0))))


def _grown(count: int) -> GlobalMap:
    """`count` views of a sphere on a plane, all but the first generated."""
    known = GlobalMap(0.01)
    for index in range(count):
        camera = scenes.orbit_camera(60.0 * index, size=_SIZE)
        view = View(_SCENE.image(camera), camera, _SCENE.depth(camera), name=f"view{index}")
        origin = Origin(GENERATED if index else GIVEN, root=0)
        known, _ = known.added(view, torch.ones(_SIZE, _SIZE), origin)
    return known


@pytest.fixture
def viewer() -> Iterator[CloudViewer]:
    pytest.importorskip("viser", reason="needs viser: the extra `viewer`")
    with CloudViewer(port=8917) as opened:
        yield opened


@pytest.fixture
def window(viewer: CloudViewer) -> Iterator[Any]:
    with headless_page(640, 420) as page:
        yield page


def test_more_views_are_more_points_and_the_sliders_take_them_away(viewer: CloudViewer) -> None:
    viewer.show(_grown(1))
    first = viewer.shown_points
    viewer.show(_grown(3))
    assert viewer.shown_points > first > 0
    viewer.select(views=1, least_confidence=0.1)
    assert viewer.shown_points == first
    viewer.show(_grown(4))  # whoever has gone back is left in peace
    assert viewer.shown_points == first
    viewer.select(views=4, least_confidence=1.0)
    assert viewer.shown_points <= len(_grown(4)) * _SIZE**2


def test_a_slider_that_moves_while_a_view_comes_waits_for_all_of_it(
    viewer: CloudViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server calls from threads of its own, in the middle of `show`."""
    viewer.show(_grown(1))
    add, failures, visitors = viewer._add_frustum, [], []

    def visit() -> None:
        try:
            viewer.select(views=2, least_confidence=0.5)
        except Exception as error:
            failures.append(error)

    def add_while_visited(index: int, view: MapView) -> None:
        visitors.append(threading.Thread(target=visit))
        visitors[-1].start()
        visitors[-1].join(timeout=0.1)
        add(index, view)

    monkeypatch.setattr(viewer, "_add_frustum", add_while_visited)
    viewer.show(_grown(3))
    for visitor in visitors:
        visitor.join()
    assert not failures
    at_once = viewer.shown_points
    viewer.select(views=2, least_confidence=0.5)
    assert viewer.shown_points == at_once


def test_a_view_that_comes_is_drawn_once(
    viewer: CloudViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []
    draw = viewer._draw
    monkeypatch.setattr(viewer, "_draw", lambda: drawn.append(draw()))
    viewer.show(_grown(1))
    viewer.show(_grown(3))
    assert len(drawn) == 2


@pytest.mark.slow
def test_the_page_shows_cloud_and_cameras(viewer: CloudViewer, window: Any, tmp_path: Any) -> None:
    viewer.show(_grown(3))
    window.goto(f"http://localhost:{viewer.port}", wait_until="domcontentloaded")
    window.get_by_text("least confidence").first.wait_for(timeout=120_000)
    window.wait_for_timeout(4000)
    shot = tmp_path / "page.png"
    window.screenshot(path=shot, timeout=120_000)
    assert not window.errors
    values = {field.input_value() for field in window.query_selector_all("input")}
    assert str(viewer.shown_points) in values
    colours = np.asarray(Image.open(shot).convert("RGB")).reshape(-1, 3).astype(int)
    # Blue frusta of what was given, orange ones of what was generated, and points of many colours.
    blue = (colours[:, 2] - colours[:, 0] > 120) & (colours[:, 1] < 150)
    orange = (colours[:, 0] - colours[:, 2] > 150) & (colours[:, 1] > 90) & (colours[:, 1] < 180)
    assert blue.any()
    assert orange.any()
    assert len(np.unique(colours, axis=0)) > 200
