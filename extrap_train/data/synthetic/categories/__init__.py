"""Synthetic scenes by category, index and seed.

In each category's file `build(rng)` draws an object of any size; `build_scene` fits it.
"""

import zlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from extrap_train.data.synthetic.categories import apple, book, chair, cup, hydrant, teddybear
from extrap_train.data.synthetic.light import draw_light
from extrap_train.data.synthetic.parts import Part, SyntheticScene, placement
from extrap_train.data.synthetic.shapes import move_mesh
from extrap_train.data.synthetic.surroundings import indoors, on_table, outdoors
from extrap_train.errors import InputError

_OBJECTS: dict[str, Callable[[np.random.Generator], list[Part]]] = {
    "apple": apple.build,
    "book": book.build,
    "chair": chair.build,
    "cup": cup.build,
    "hydrant": hydrant.build,
    "teddybear": teddybear.build,
}
# How likely each category is found outdoors, on a floor, on a table.
_PLACES: dict[str, tuple[float, float, float]] = {
    "apple": (0.2, 0.0, 0.8),
    "book": (0.15, 0.2, 0.65),
    "chair": (0.3, 0.7, 0.0),
    "cup": (0.2, 0.0, 0.8),
    "hydrant": (1.0, 0.0, 0.0),
    "teddybear": (0.25, 0.4, 0.35),
}


def build_scene(category: str, index: int, seed: int) -> SyntheticScene:
    """The scene with this number; raises InputError for a category that is not synthetic."""
    if category not in _OBJECTS:
        raise InputError(
            f"no synthetic category '{category}'; there are {', '.join(sorted(_OBJECTS))}"
        )
    rng = np.random.default_rng([seed, zlib.crc32(category.encode()), index])
    thing = _fit_to_ground(_OBJECTS[category](rng), turn_rad=rng.uniform(0, 2 * np.pi))
    place = int(rng.choice(3, p=_PLACES[category]))
    around = (outdoors, indoors, on_table)[place](rng)
    corners = np.concatenate([move_mesh(p.mesh, p.part_to_world).vertices for p in thing])
    low, high = corners.min(0), corners.max(0)
    middle = (low + high) / 2
    return SyntheticScene(
        category,
        (*thing, *around),
        draw_light(rng, indoors=place > 0),
        look_at=middle,
        radius=float(np.linalg.norm(corners - middle, axis=1).max()),
    )


def _fit_to_ground(parts: list[Part], turn_rad: float) -> list[Part]:
    """The object scaled to a largest extent of 1, turned, and set on the ground at the origin."""
    turned = [_transform_part(placement(turn_rad=turn_rad), part) for part in parts]
    corners = np.concatenate([move_mesh(p.mesh, p.part_to_world).vertices for p in turned])
    low, high = corners.min(0), corners.max(0)
    scale = 1 / (high - low).max()
    shift = -scale * np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    return [_transform_part(placement(shift, scale=scale), part) for part in turned]


def _transform_part(transform: np.ndarray, part: Part) -> Part:
    return replace(part, part_to_world=transform @ part.part_to_world)
