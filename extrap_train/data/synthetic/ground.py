"""What objects stand on: lawns, pavements, floors and table tops."""

import numpy as np

from extrap_train.data.synthetic.kernels import Real
from extrap_train.data.synthetic.material import (
    Material,
    Mottled,
    Plaid,
    Texture,
    Tiling,
    Worn,
    linear_color,
    vary_color,
)
from extrap_train.data.synthetic.parts import Part, placement
from extrap_train.data.synthetic.shapes import flat_ground, lathe, rounded_box

WOODS = ["#a06a3d", "#b9834c", "#8a5c36", "#d0aa74", "#6e4a34"]
FLOOR_WOODS = ["#b98a58", "#cfa56e", "#a67c55", "#d8bd92", "#94724f", "#b5a48c"]
CLOTHS = ["#8c2f39", "#2f4b7c", "#3d6b4f", "#d9cfb8", "#7a6a8f", "#b98b4e", "#5b5b66"]
STONES = ["#9c9891", "#b3a896", "#7f8184", "#a58f7b"]


def draw_seed(rng: np.random.Generator) -> int:
    """A seed for a texture's noise."""
    return int(rng.integers(1 << 20))


def lawn(rng: np.random.Generator) -> Texture:
    """Grass with drier patches."""
    green = vary_color(rng, ["#4f7a2f", "#5f8a3a", "#6d7f3a", "#3f6b35"])
    grass = Mottled(green * 0.45, green * 1.5, rng.uniform(9, 14), draw_seed(rng), 3, 0.9)
    return Worn(grass, vary_color(rng, ["#8f8350", "#7a6a45"]), 0.25, 0.9, draw_seed(rng), 1e-3)


def gravel(rng: np.random.Generator) -> Texture:
    """Bare earth, asphalt or gravel."""
    tone = vary_color(rng, ["#8a7558", "#6f6f70", "#a39377", "#5d5a57"])
    coarse = Mottled(tone * 0.6, tone * 1.35, rng.uniform(8, 14), draw_seed(rng), 3, 0.8)
    return Worn(coarse, tone * rng.uniform(0.4, 0.6), 0.3, 1.1, draw_seed(rng), 1e-3)


def pavement(rng: np.random.Generator) -> Texture:
    """Slabs or setts with joints."""
    tone = vary_color(rng, STONES)
    size = rng.uniform(0.35, 0.9)
    stone = Mottled(tone * 0.75, tone * 1.2, rng.uniform(3, 7), draw_seed(rng), 3, 0.8)
    return Tiling(
        stone, tone * 0.35, (size * rng.uniform(1, 2), size), draw_seed(rng), 0.04, 0.5, 0.22
    )


def bricks(rng: np.random.Generator) -> Texture:
    """Brickwork, for paths and walls."""
    tone = vary_color(rng, ["#9a4f3a", "#b06a4a", "#a8805e", "#7d4338"])
    clay = Mottled(tone * 0.7, tone * 1.25, 5.0, draw_seed(rng), 2, 0.7)
    return Tiling(clay, linear_color("#b8b0a4"), (0.46, 0.19), draw_seed(rng), 0.03, 0.5, 0.3)


def floorboards(rng: np.random.Generator) -> Texture:
    """Planks with grain along X."""
    tone = vary_color(rng, FLOOR_WOODS)
    grain = Mottled(tone * 0.6, tone * 1.3, 7.0, draw_seed(rng), 3, 0.8, stretch=(0.12, 1.0, 1.0))
    size = (rng.uniform(1.5, 2.5), rng.uniform(0.2, 0.4))
    return Tiling(grain, tone * 0.25, size, draw_seed(rng), 0.02, 0.37, 0.3)


def floor_tiles(rng: np.random.Generator) -> Texture:
    """Ceramic tiles, sometimes a chessboard."""
    tone = vary_color(rng, ["#cfc8ba", "#b7c0bd", "#a8927a", "#d8d2c8"])
    second = vary_color(rng, ["#4a4a4f", "#7c4a3a", "#48605a"]) if rng.random() < 0.5 else None
    inside = Mottled(tone * 0.8, tone, 2.5, draw_seed(rng), 3, 0.8)
    size = rng.uniform(0.4, 0.8)
    return Tiling(inside, tone * 0.4, (size, size), draw_seed(rng), 0.03, 0.0, 0.1, second)


def carpet(rng: np.random.Generator) -> Texture:
    """A carpet or a table cloth."""
    base = vary_color(rng, CLOTHS)
    if rng.random() < 0.5:
        return Plaid(base, vary_color(rng, CLOTHS), vary_color(rng, CLOTHS), rng.uniform(0.3, 0.7))
    return Mottled(base * 0.6, base * 1.35, rng.uniform(4, 9), draw_seed(rng), 3, 0.9)


def table_wood(rng: np.random.Generator) -> Texture:
    """A polished board of one or several planks."""
    tone = vary_color(rng, FLOOR_WOODS + WOODS[:2])
    return Tiling(
        Mottled(tone * 0.6, tone * 1.25, 6.0, draw_seed(rng), 3, 0.9, stretch=(0.13, 1.0, 1.0)),
        tone * 0.35,
        (9.0, rng.uniform(0.5, 1.2)),
        draw_seed(rng),
        0.012,
        shades=0.12,
    )


def wide_ground(texture: Texture, half: Real, gloss: Real = 0.0) -> list[Part]:
    """A ground that reaches as far as the surroundings do."""
    material = Material(texture, gloss)
    return [Part(flat_ground((half, half)), material, is_object=False, casts_shadow=False)]


def table(rng: np.random.Generator, floor_height: Real) -> list[Part]:
    """A table under the object, tall as seen from an apple; its floor lies at `floor_height`."""
    texture = table_wood(rng) if rng.random() < 0.65 else carpet(rng)
    material = Material(texture, gloss=0.08 if isinstance(texture, Tiling) else 0.0)
    x, y = rng.uniform(2.3, 3.6), rng.uniform(2.3, 3.2)
    edge = Material(table_wood(rng))
    turn = rng.uniform(0, np.pi)
    top = Part(flat_ground((x, y)), material, placement(turn_rad=turn), False, False)
    parts = [
        top,
        Part(rounded_box((2 * x, 2 * y, 0.2)), edge, placement((0, 0, -0.102), turn), False, True),
    ]
    leg = lathe([[0.14, floor_height], [0.2, -0.2]], 10)
    cos, sin = np.cos(turn), np.sin(turn)
    for sx in (-1, 1):
        for sy in (-1, 1):
            px, py = sx * (x - 0.4), sy * (y - 0.4)
            spot = (cos * px - sin * py, sin * px + cos * py, 0.0)
            parts.append(Part(leg, edge, placement(spot), False, False))
    return parts
