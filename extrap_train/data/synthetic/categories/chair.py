"""Chairs: four legs or a pedestal, plain, slatted or upholstered backs, sometimes armrests."""

from collections.abc import Callable

import numpy as np

from extrap_train.data.synthetic.ground import CLOTHS, WOODS, draw_seed
from extrap_train.data.synthetic.kernels import Real
from extrap_train.data.synthetic.material import Material, Mottled, Plaid, Plain, Wood, vary_color
from extrap_train.data.synthetic.parts import Part, placement
from extrap_train.data.synthetic.shapes import Mesh, capsule, lathe, rounded_box, sheet, sweep, xyz

PLACES = (0.3, 0.7, 0.0)
"""How likely one is found outdoors, on a floor, on a table."""

Back = Callable[[float, float], np.ndarray]
"""A point of the back: -1 left … 1 right, 0 seat … 1 top."""
_PAINTS = ["#c9c4b8", "#7a2f2f", "#2f5a5f", "#d9b04a", "#3a3f4a", "#4f7a4f", "#b8623a"]


def build(rng: np.random.Generator) -> list[Part]:
    """One chair whose back stands at +Y."""
    width, depth = rng.uniform(0.4, 0.54), rng.uniform(0.4, 0.5)
    seat = rng.uniform(0.4, 0.5)
    top = seat + rng.uniform(0.4, 0.62)
    frame = _frame_material(rng)
    parts = _seat(rng, (width, depth, seat), frame)
    pedestal = rng.random() < 0.28
    if pedestal:
        parts += _pedestal(rng, seat, min(width, depth))
    else:
        parts += _legs(rng, (width, depth, seat), frame)
    parts += _back(rng, (width, depth, seat), top, frame)
    if rng.random() < 0.4:
        parts += _armrests(rng, (width, depth, seat), frame)
    return parts


def _frame_material(rng: np.random.Generator) -> Material:
    if rng.random() < 0.6:
        tone = vary_color(rng, WOODS)
        return Material(Wood(tone * 0.5, tone * 1.2, draw_seed(rng)), 0.25, 30)
    tone = vary_color(rng, _PAINTS)
    return Material(Mottled(tone * 0.85, tone * 1.05, 4.0, draw_seed(rng)), 0.35, 40)


def _cloth(rng: np.random.Generator) -> Material:
    base = vary_color(rng, CLOTHS)
    if rng.random() < 0.5:
        period = rng.uniform(0.08, 0.2)
        return Material(Plaid(base, vary_color(rng, CLOTHS), vary_color(rng, CLOTHS), period))
    return Material(Mottled(base * 0.6, base * 1.3, rng.uniform(10, 22), draw_seed(rng)))


def _seat(rng: np.random.Generator, size: tuple[Real, Real, Real], frame: Material) -> list[Part]:
    width, depth, height = size
    board = rounded_box((width, depth, 0.04), 0.015)
    parts = [Part(board, frame, placement((0, 0, height)))]
    if rng.random() < 0.6:
        thick = rng.uniform(0.05, 0.1)
        cushion = rounded_box((width * 0.95, depth * 0.95, thick), thick * 0.45, 3)
        parts.append(Part(cushion, _cloth(rng), placement((0, 0, height + 0.01 + thick / 2))))
    return parts


def _legs(rng: np.random.Generator, size: tuple[Real, Real, Real], frame: Material) -> list[Part]:
    width, depth, height = size
    thick, splay = rng.uniform(0.02, 0.032), rng.uniform(0, 0.06)
    taper = rng.uniform(0.6, 1.0)
    x, y = width / 2 - 0.04, depth / 2 - 0.04
    parts = []
    for sx in (-1, 1):
        for sy in (-1, 1):
            head = np.array([sx * x, sy * y, height])
            foot = np.array([sx * (x + splay), sy * (y + splay), thick * taper])
            parts.append(Part(capsule(head, foot, thick, thick * taper, 12), frame))
    if rng.random() < 0.6:
        low = height * rng.uniform(0.25, 0.55)
        out = 1 + splay / x * (1 - low / height)
        for side in (-1, 1):
            bar = capsule(
                np.array([side * x * out, -y * out, low]),
                np.array([side * x * out, y * out, low]),
                0.014,
            )
            parts.append(Part(bar, frame))
    return parts


def _pedestal(rng: np.random.Generator, seat: Real, width: Real) -> list[Part]:
    """A column on a round foot or on five spokes with castors."""
    metal = Material(Plain(vary_color(rng, ["#8f9296", "#2c2c30", "#c9c9c6"])), 0.6, 50)
    column = lathe([[0.035, 0.05], [0.035, 0.2], [0.025, 0.2], [0.025, seat]], 16)
    if rng.random() < 0.4:
        foot = [[0, 0], [width * 0.5, 0], [width * 0.5, 0.02], [0.05, 0.06], [0, 0.06]]
        return [Part(column, metal), Part(lathe(foot, 32), metal)]
    parts = [Part(column, metal)]
    for turn in 2 * np.pi * np.arange(5) / 5:
        tip = np.array([np.cos(turn), np.sin(turn), 0.0]) * width * 0.55
        parts.append(
            Part(capsule(np.array([0, 0, 0.1]), tip + xyz(0, 0, 0.07), 0.025, 0.018), metal)
        )
        parts.append(Part(capsule(tip + xyz(0, 0, 0.03), tip + xyz(0, 0, 0.031), 0.03), metal))
    return parts


def _back(
    rng: np.random.Generator, size: tuple[Real, Real, Real], top: Real, frame: Material
) -> list[Part]:
    """Two posts that lean back, and what is between them."""
    width, depth, seat = size
    lean = rng.uniform(0.03, 0.14)
    x, y = width / 2 - 0.03, depth / 2 - 0.03

    def at(share_x: Real, share_z: Real) -> np.ndarray:
        return np.array([share_x * x, y + lean * share_z**1.4, seat + share_z * (top - seat)])

    posts = [Part(capsule(at(s, 0), at(s, 1), 0.024, 0.02, 12), frame) for s in (-1, 1)]
    heights = np.linspace(0, 1, 10)
    match rng.integers(4):
        case 0:
            count = int(rng.integers(3, 7))
            bars = [
                Part(sweep([at(s, t) for t in heights], 0.014, 8), frame)
                for s in np.linspace(-1, 1, count + 2)[1:-1]
            ]
            return [*posts, *bars, _rail(at, 1.0, 0.035, frame)]
        case 1:
            rails = np.linspace(0.35, 1.0, int(rng.integers(2, 5)))
            return posts + [_rail(at, t, rng.uniform(0.03, 0.05), frame) for t in rails]
        case 2:
            low = rng.uniform(0.1, 0.35)
            panel = _panel(at, low, 1.02)
            return [*posts, Part(panel, frame), _rail(at, 1.0, 0.03, frame)]
        case _:
            cushion = rounded_box((2 * x, rng.uniform(0.06, 0.1), (top - seat) * 0.85), 0.03, 3)
            tilt = -np.arctan2(lean, top - seat)
            pose = placement(at(0, 0.58), tilt_rad=tilt)
            return [*posts, Part(cushion, _cloth(rng), pose)]


def _rail(at: Back, share_z: Real, half: Real, frame: Material) -> Part:
    """A slat across the back, bowed a little."""
    across = np.linspace(-1, 1, 9)
    path = np.array([at(s, share_z) + xyz(0, 0.03 * (1 - s * s), 0) for s in across])
    return Part(sweep(path, half, 10, flatten=0.35), frame)


def _panel(at: Back, low: Real, high: Real) -> Mesh:
    """A bent board between the posts."""
    grid = [[at(s, t) for s in np.linspace(-1, 1, 8)] for t in np.linspace(low, high, 8)]
    return sheet(grid)


def _armrests(
    rng: np.random.Generator, size: tuple[Real, Real, Real], frame: Material
) -> list[Part]:
    width, depth, seat = size
    height, x = seat + rng.uniform(0.18, 0.26), width / 2
    parts = []
    for side in (-1, 1):
        board = rounded_box((0.05, depth * 0.95, 0.03), 0.012)
        parts.append(Part(board, frame, placement((side * x, 0.02, height))))
        front = np.array([side * x, -depth / 2 + 0.06, seat])
        parts.append(Part(capsule(front, front + xyz(0, 0, height - seat), 0.016), frame))
    return parts
