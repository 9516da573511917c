"""What stands around the object: everything has depth, so everything moves when the camera does."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from extrap_train.data.synthetic import ground
from extrap_train.data.synthetic.ground import draw_seed
from extrap_train.data.synthetic.kernels import Real, fractal_noise
from extrap_train.data.synthetic.material import (
    Color,
    LocalPoints,
    Material,
    Mottled,
    Plain,
    Texture,
    Tiling,
    linear_color,
    mix,
    vary_color,
)
from extrap_train.data.synthetic.parts import Part, placement
from extrap_train.data.synthetic.shapes import (
    Mesh,
    Point,
    capsule,
    displace,
    ellipsoid,
    lathe,
    rounded_box,
)

_SKY_RADIUS = 19.0
_PAINTS = ["#b5483c", "#3f6fa3", "#d8b24a", "#5c8a5a", "#cfc6b6", "#6d5a86", "#444b55", "#c98a4b"]


@dataclass(frozen=True)
class Sky:
    """Zenith over horizon with clouds; below it, distant hills."""

    zenith: Color
    horizon: Color
    hills: Color
    seed: int

    def __call__(self, surface: LocalPoints) -> Float[np.ndarray, "n 3"]:
        """Radiance in linear light."""
        direction = surface.points / _SKY_RADIUS
        clouds = fractal_noise(direction, surface.footprint / _SKY_RADIUS, 3.0, 4, self.seed)
        height = np.clip(direction[:, 2], 0, 1)
        sky = mix(self.horizon, self.zenith, height**0.6)
        sky = mix(sky, np.full(3, 0.95), (clouds - 0.05) * 2.2)
        ridge = direction * np.array([1, 1, 0], np.float32)
        skyline = 0.05 + 0.08 * fractal_noise(
            ridge, surface.footprint / _SKY_RADIUS, 4.0, 4, self.seed + 50
        )
        return mix(sky, self.hills, (skyline - direction[:, 2]) * 60 + 0.5)


def outdoors(rng: np.random.Generator) -> list[Part]:
    """A lawn, a path or a street with bushes, trees, walls and boxes, under a sky."""
    makers = [ground.lawn, ground.gravel, ground.pavement, ground.bricks]
    texture = makers[rng.choice(4, p=[0.3, 0.2, 0.35, 0.15])](rng)
    sky = Sky(
        vary_color(rng, ["#5f93cf", "#7fa9d6", "#9db4c8"]),
        vary_color(rng, ["#cfdde8", "#dfe3e2", "#e9ddca"]),
        vary_color(rng, ["#5d7358", "#6f7f86", "#7c7a63"]),
        draw_seed(rng),
    )
    parts = [*ground.wide_ground(texture, 18.0), _dome(sky)]
    makers_of_things = [_bush, _tree, _wall, _crate, _post, _bush]
    for spot, turn in _around(rng, int(rng.integers(9, 14)), 3.2, 6.5):
        parts += makers_of_things[rng.integers(len(makers_of_things))](rng, spot, turn)
    for spot, turn in _around(rng, int(rng.integers(3, 6)), 9.0, 13.0):
        parts += _house(rng, spot, turn)
    return parts


def indoors(rng: np.random.Generator) -> list[Part]:
    """A room with furniture along its walls; the object stands on the floor."""
    makers = [ground.floorboards, ground.floor_tiles, ground.carpet]
    texture = makers[rng.integers(3)](rng)
    half, height = rng.uniform(4.6, 7.0, 2), rng.uniform(4.5, 6.0)
    parts = [*ground.wide_ground(texture, 8.0, gloss=0.1), *_room(rng, half, 0.0, height)]
    for spot, turn in _around(rng, int(rng.integers(8, 12)), 3.2, 4.6):
        makers_of_things = [_cabinet, _crate, _lamp, _plant, _cabinet]
        parts += makers_of_things[rng.integers(len(makers_of_things))](rng, spot, turn)
    return parts


def on_table(rng: np.random.Generator) -> list[Part]:
    """A table in a room, with other things near its edge and furniture on the floor below."""
    floor = -rng.uniform(2.5, 3.5)
    half, height = rng.uniform(6.0, 9.0, 2), rng.uniform(6.0, 8.0)
    floor_texture = [ground.floorboards, ground.floor_tiles, ground.carpet][rng.integers(3)](rng)
    parts = ground.table(rng, floor)
    parts += [
        Part(p.mesh, p.material, placement((0, 0, floor)), False, False)
        for p in ground.wide_ground(floor_texture, 10.0)
    ]
    parts += _room(rng, half, floor, height)
    for spot, turn in _around(rng, int(rng.integers(3, 6)), 2.0, 2.3):
        parts += _small_thing(rng, spot, turn)
    for spot, turn in _around(rng, int(rng.integers(7, 10)), 4.5, 6.0):
        makers_of_things = [_cabinet, _crate, _lamp, _plant]
        below = (spot[0], spot[1], floor)
        parts += makers_of_things[rng.integers(len(makers_of_things))](rng, below, turn, 1.9)
    return parts


def _around(
    rng: np.random.Generator, count: int, nearest: Real, farthest: Real
) -> list[tuple[Point, float]]:
    """Spots spread over the circle, each with the turn that faces the centre."""
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-0.35, 0.35, count)) / count
    angles += rng.uniform(0, 2 * np.pi)
    radii = rng.uniform(nearest, farthest, count)
    return [
        ((float(r * np.cos(a)), float(r * np.sin(a)), 0.0), float(a + np.pi / 2))
        for a, r in zip(angles, radii, strict=True)
    ]


def _scenery(mesh: Mesh, material: Material, spot: Point, turn: Real, scale: Real = 1.0) -> Part:
    return Part(mesh, material, placement(spot, turn, scale=scale), is_object=False)


def _dome(texture: Texture) -> Part:
    mesh = ellipsoid((_SKY_RADIUS,) * 3, 48)
    return Part(mesh, Material(texture, glow=1), is_object=False, casts_shadow=False)


def _room(
    rng: np.random.Generator, half: Float[np.ndarray, " 2"], floor: Real, height: Real
) -> list[Part]:
    """Four walls and a ceiling with pictures and windows."""
    tone = vary_color(rng, ["#d8cfc0", "#b9c4c0", "#c7b299", "#a9b3c4", "#cdbfc3", "#9aa78f"])
    wall: Texture
    match rng.integers(4):
        case 0:
            wall = ground.bricks(rng)
        case 1:
            wall = Tiling(Plain(tone), tone * 0.7, (0.8, 40.0), draw_seed(rng), 0.3, shades=0.15)
        case 2:
            wall = Tiling(Plain(tone), tone * 0.6, (1.2, 1.2), draw_seed(rng), 0.06, shades=0.1)
        case _:
            wall = Mottled(tone * 0.75, tone * 1.1, 1.2, draw_seed(rng), 4, 0.9)
    below = 0.5  # the box's own floor lies under the ground
    box = rounded_box((2 * half[0], 2 * half[1], height + below))
    middle = (0.0, 0.0, floor + (height - below) / 2)
    parts = [Part(box, Material(wall), placement(middle), False, False)]
    for side in range(4):
        axis, sign = side % 2, 1 if side < 2 else -1
        for place in rng.uniform(-0.8, 0.8, rng.integers(2, 4)):
            position = np.zeros(3)
            position[axis] = sign * (half[axis] - 0.03)
            position[1 - axis] = place * half[1 - axis]
            position[2] = max(floor + height * rng.uniform(0.35, 0.7), 0.9)
            turn = np.pi / 2 if axis == 0 else 0.0
            parts += _hanging(rng, (position[0], position[1], position[2]), turn)
    return parts


def _hanging(rng: np.random.Generator, spot: Point, turn: Real) -> list[Part]:
    """A picture, a door-like panel or a bright window on a wall."""
    width, height = rng.uniform(0.8, 2.2), rng.uniform(0.8, 1.8)
    frame = rounded_box((width + 0.16, 0.1, height + 0.16))
    pane = rounded_box((width, 0.16, height))
    if rng.random() < 0.35:
        glass = linear_color("#dfeaf2")
        texture: Texture = Tiling(
            Plain(glass), linear_color("#8a8a86"), (width / 2, height / 2), 1, 0.07
        )
        material = Material(texture, glow=1)
    else:
        low, high = vary_color(rng, _PAINTS), vary_color(rng, _PAINTS)
        material = Material(Mottled(low, high, rng.uniform(0.8, 2.5), draw_seed(rng), 3, 2.0))
    wood = Material(Plain(vary_color(rng, ground.WOODS)))
    return [
        Part(frame, wood, placement(spot, turn), False, False),
        Part(pane, material, placement(spot, turn), False, False),
    ]


def _bush(rng: np.random.Generator, spot: Point, turn: Real) -> list[Part]:
    size = rng.uniform(0.6, 1.3)
    return [_foliage(rng, (spot[0], spot[1], size * 0.45), size)]


def _foliage(rng: np.random.Generator, spot: Point, size: Real) -> Part:
    green = vary_color(rng, ["#3f6b2f", "#56803a", "#6f8a3f", "#7f7a3a", "#9a5f3a"])
    ball = ellipsoid((0.55, 0.5, 0.5), 20)
    flat = np.zeros(len(ball.vertices), np.float32)
    bumps = fractal_noise(ball.vertices.astype(np.float32), flat, 4.0, 2, draw_seed(rng))
    mesh = displace(ball, 0.25 * bumps[:, None] * ball.normals)
    texture = Mottled(green * 0.3, green * 1.5, 8.0, draw_seed(rng), 3, 1.1)
    return _scenery(mesh, Material(texture, roughness=0.6), spot, rng.uniform(0, 6), size)


def _tree(rng: np.random.Generator, spot: Point, turn: Real) -> list[Part]:
    height = rng.uniform(2.0, 3.2)
    bark = vary_color(rng, ["#5a4632", "#7a6a55", "#4a4038"])
    trunk = lathe([[0.22, 0], [0.14, 0.4], [0.11, height]], 12)
    texture = Mottled(bark * 0.5, bark * 1.4, 7.0, draw_seed(rng), 3, stretch=(1, 1, 0.25))
    crown = (spot[0], spot[1], height + 0.5)
    return [
        _scenery(trunk, Material(texture), spot, turn),
        _foliage(rng, crown, rng.uniform(2.0, 3.0)),
    ]


def _wall(rng: np.random.Generator, spot: Point, turn: Real) -> list[Part]:
    size = (rng.uniform(1.5, 3.0), 0.3, rng.uniform(0.5, 1.4))
    texture = ground.bricks(rng) if rng.random() < 0.6 else ground.pavement(rng)
    middle = (spot[0], spot[1], size[2] / 2)
    return [_scenery(rounded_box(size, 0.03, 1), Material(texture), middle, turn)]


def _crate(rng: np.random.Generator, spot: Point, turn: Real, scale: Real = 1.0) -> list[Part]:
    size = rng.uniform(0.4, 1.0, 3) * scale
    tone = vary_color(rng, _PAINTS)
    inside = Mottled(tone * 0.7, tone * 1.2, 5.0, draw_seed(rng), 2, stretch=(1, 1, 0.3))
    texture = Tiling(inside, tone * 0.4, (0.9, rng.uniform(0.15, 0.5)), draw_seed(rng), 0.03)
    middle = (spot[0], spot[1], spot[2] + size[2] / 2)
    twist = turn + rng.uniform(-0.6, 0.6)
    return [_scenery(rounded_box(tuple(size), 0.03, 1), Material(texture), middle, twist)]


def _post(rng: np.random.Generator, spot: Point, turn: Real) -> list[Part]:
    radius, height = rng.uniform(0.06, 0.2), rng.uniform(0.8, 3.0)
    profile = np.array(
        [
            [radius * 1.6, 0],
            [radius * 1.6, 0.1],
            [radius, 0.12],
            [radius, height],
            [0, height + radius],
        ]
    )
    tone = vary_color(rng, _PAINTS)
    texture = Tiling(Plain(tone), vary_color(rng, _PAINTS), (50.0, rng.uniform(0.4, 1.0)), 3, 0.15)
    return [_scenery(lathe(profile, 14), Material(texture, 0.3), spot, turn)]


def _house(rng: np.random.Generator, spot: Point, turn: Real) -> list[Part]:
    size = (rng.uniform(3, 6), rng.uniform(2, 4), rng.uniform(2, 6))
    tone = vary_color(rng, ["#c9bfae", "#b08a6a", "#a9adb0", "#d3c48f", "#9a6a5a"])
    panes = Plain(vary_color(rng, ["#3a4a5a", "#55646e"]))
    texture = Tiling(
        panes, tone, (rng.uniform(0.9, 1.4), rng.uniform(1.0, 1.5)), 5, 0.6, shades=0.4
    )
    middle = (spot[0], spot[1], size[2] / 2)
    return [_scenery(rounded_box(size), Material(texture), middle, turn)]


def _cabinet(rng: np.random.Generator, spot: Point, turn: Real, scale: Real = 1.0) -> list[Part]:
    size = (rng.uniform(0.8, 2.0) * scale, 0.5 * scale, rng.uniform(0.5, 2.2) * scale)
    tone = vary_color(rng, ground.WOODS + _PAINTS[4:6])
    grain = Mottled(tone * 0.65, tone * 1.25, 4.0, draw_seed(rng), 2, stretch=(0.2, 0.2, 1))
    cells = (size[0] / rng.integers(1, 4), size[2] / rng.integers(1, 5))
    texture = Tiling(grain, tone * 0.3, cells, draw_seed(rng), 0.05, shades=0.2)
    middle = (spot[0], spot[1], spot[2] + size[2] / 2)
    return [_scenery(rounded_box(size, 0.02, 1), Material(texture, 0.1), middle, turn)]


def _lamp(rng: np.random.Generator, spot: Point, turn: Real, scale: Real = 1.0) -> list[Part]:
    height = rng.uniform(1.6, 2.4) * scale
    metal = Material(Plain(vary_color(rng, ["#3a3a3c", "#a08a5a", "#c8c8c8"])), 0.4)
    pole = lathe([[0.3, 0], [0.3, 0.05], [0.04, 0.07], [0.04, height]], 12)
    shade = lathe([[0.38, height - 0.3], [0.22, height + 0.25]], 20)
    cloth = Material(Plain(vary_color(rng, ["#e8d9b0", "#d9a45a", "#dfe0da", "#c77f6a"])), glow=1)
    return [_scenery(pole, metal, spot, turn), _scenery(shade, cloth, spot, turn)]


def _plant(rng: np.random.Generator, spot: Point, turn: Real, scale: Real = 1.0) -> list[Part]:
    size = rng.uniform(0.35, 0.6) * scale
    pot = lathe(np.array([[0.3, 0], [0.45, 0.8], [0.38, 0.8], [0.36, 0.7], [0, 0.7]]) * size, 18)
    dark, pale = (vary_color(rng, ["#a85f40", "#d8d2c4", "#4f5f6f"]) for _ in range(2))
    clay = Material(Mottled(dark * 0.7, pale * 1.1, 4.0, 3))
    leaves = _foliage(rng, (spot[0], spot[1], spot[2] + 1.3 * size), 1.6 * size)
    return [_scenery(pot, clay, spot, turn), leaves]


def _small_thing(rng: np.random.Generator, spot: Point, turn: Real) -> list[Part]:
    """A box, a bottle or a ball near the edge of a table."""
    tone = vary_color(rng, _PAINTS)
    material = Material(
        Mottled(tone * 0.7, vary_color(rng, _PAINTS), 3.0, draw_seed(rng), 2, 1.5), 0.2
    )
    match rng.integers(3):
        case 0:
            size = tuple(rng.uniform(0.15, 0.4, 3))
            middle = (spot[0], spot[1], size[2] / 2)
            return [_scenery(rounded_box(size, 0.02, 1), material, middle, turn)]
        case 1:
            h, r = rng.uniform(0.35, 0.6), rng.uniform(0.07, 0.13)
            profile = [[r, 0], [r, 0.6 * h], [r * 0.4, 0.8 * h], [r * 0.4, h], [0, h]]
            return [_scenery(lathe(profile, 16), material, spot, turn)]
        case _:
            r = rng.uniform(0.1, 0.2)
            middle = (spot[0], spot[1], r)
            return [
                _scenery(capsule(np.zeros(3), np.array([0, 0, 1e-3]), r), material, middle, turn)
            ]
