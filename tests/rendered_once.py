"""Synthetic captures that are rendered once for all tests to which they are mere input."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

import pytest

from extrap_train.data.synthetic import capture
from extrap_train.data.synthetic.parts import SyntheticScene
from extrap_train.views import Camera, View

_build_scene = cache(capture.build_scene)
_render = capture.render
_rendered: dict[tuple[object, ...], tuple[SyntheticScene, View]] = {}
"""By the scene's id, which nothing else has while the scene is kept."""


def _photograph(scene: SyntheticScene, camera: Camera) -> View:
    """A copy, so that no test sees what another one does to it."""
    pose = camera.world_to_cam.numpy().tobytes(), camera.intrinsics.numpy().tobytes()
    key = (id(scene), camera.height, camera.width, *pose)
    if key not in _rendered:
        _rendered[key] = scene, _render(scene, camera)
    _, view = _rendered[key]
    assert view.depth is not None
    assert view.mask is not None
    return replace(view, image=view.image.clone(), depth=view.depth.clone(), mask=view.mask.clone())


@contextmanager
def rendered_once() -> Iterator[None]:
    """Within it, scenes named `synthetic:` and a table's synthetic captures come from memory."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(capture, "build_scene", _build_scene)
        patch.setattr(capture, "render", _photograph)
        yield
