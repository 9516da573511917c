"""Synthetic scenes by category, index and seed.

Every module here is a category: its `build(rng)` draws an object of any size, which `build_scene`
fits, and its `PLACES` say where one is found.
"""

import importlib
import pkgutil
import zlib
from dataclasses import replace

import numpy as np

from extrap_train.data.synthetic.parts import Part, SyntheticScene, draw_light, placement
from extrap_train.data.synthetic.shapes import move_mesh
from extrap_train.data.synthetic.surroundings import indoors, on_table, outdoors
from extrap_train.errors import InputError

NAMES = tuple(sorted(module.name for module in pkgutil.iter_modules(__path__)))


def build_scene(category: str, index: int, seed: int) -> SyntheticScene:
    """The scene with this number; raises InputError for a category that is not synthetic."""
    if category not in NAMES:
        raise InputError(
            f"no synthetic category '{category}'; there are {', '.join(NAMES)}. For captures of "
            "your own give data=folders data.root=FOLDER, or for a table `benchmark run own`"
        )
    module = importlib.import_module(f"{__name__}.{category}")
    rng = np.random.default_rng([seed, zlib.crc32(category.encode()), index])
    thing = _fit_to_ground(module.build(rng), turn_rad=rng.uniform(0, 2 * np.pi))
    place = int(rng.choice(3, p=module.PLACES))
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
