"""Cups: mugs, tea cups and beakers with a handle; glazed in patterns."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from extrap_train.data.synthetic.ground import draw_seed
from extrap_train.data.synthetic.kernels import Real
from extrap_train.data.synthetic.material import (
    Color,
    LocalPoints,
    Material,
    Mottled,
    Numbers,
    Plain,
    linear_color,
    mix,
    step,
    vary_color,
)
from extrap_train.data.synthetic.parts import Part, placement
from extrap_train.data.synthetic.shapes import Mesh, lathe, sweep

PLACES = (0.2, 0.0, 0.8)
"""How likely one is found outdoors, on a floor, on a table."""


@dataclass(frozen=True)
class Place:
    """Where points lie in the decorated zone of a cup."""

    height: Numbers
    """0 at the zone's lower edge, 1 at its upper."""
    around: Numbers
    """Turns around the cup, in repeats of the pattern."""
    zone: Real
    """Height of the zone."""
    repeats: int
    width: Real
    """Length of one repeat."""
    blur: Numbers
    """Width of a pixel."""


Pattern = Callable[[Place], Numbers]


@dataclass(frozen=True)
class Glaze:
    """A pattern in ink on a base, between two heights; the rim and the foot in a second colour."""

    base: Color
    ink: Color
    second: Color
    pattern: Pattern
    repeats: int
    low: Real
    high: Real
    radius: Real

    def __call__(self, surface: LocalPoints) -> Float[np.ndarray, "n 3"]:
        """Reflectance in linear light."""
        x, y, z = surface.points.T
        blur, zone = surface.footprint, self.high - self.low
        around = np.arctan2(y, x) / (2 * np.pi) * self.repeats
        width = 2 * np.pi * self.radius / self.repeats
        place = Place((z - self.low) / zone, around, zone, self.repeats, width, blur)
        inside = step(z - self.low, blur) * step(self.high - z, blur)
        color = mix(self.base, self.ink, self.pattern(place) * inside)
        rim = step(z - self.high - 0.02, blur) + step(self.low - 0.02 - z, blur)
        return mix(color, self.second, rim)


def bands(place: Place) -> Numbers:
    """Three rings."""
    phase = place.height * 3
    wave = 0.5 - np.abs(phase - np.floor(phase) - 0.5)
    return step((wave - 0.22) * place.zone / 3, place.blur)


def stripes(place: Place) -> Numbers:
    """Upright stripes."""
    return step((_to_nearest(place.around) - 0.25) * place.width, place.blur)


def dots(place: Place) -> Numbers:
    """Discs in staggered rows."""
    rows = place.height * place.zone / place.width
    shifted = place.around + 0.5 * (np.floor(rows) % 2)
    far = np.hypot(shifted - np.round(shifted), rows - np.floor(rows) - 0.5)
    return step((0.33 - far) * place.width, place.blur)


def zigzag(place: Place) -> Numbers:
    """One jagged line."""
    line = 0.25 + _to_nearest(place.around)
    return step((0.2 - np.abs(place.height - line)) * place.zone, place.blur)


def emblem(place: Place) -> Numbers:
    """A disc with a diamond left out, on both sides of the handle."""
    sides = place.around * 2 / place.repeats + 0.5
    x = (sides - np.round(sides)) * place.width * place.repeats / 2
    y = (place.height - 0.5) * place.zone
    size = 0.42 * place.zone
    disc = step(size - np.hypot(x, y), place.blur)
    diamond = step(size * 0.75 - (np.abs(x) + np.abs(y)), place.blur)
    return disc * (1 - 0.9 * diamond)


def _to_nearest(x: Numbers) -> Numbers:
    """Distance to the nearest whole number."""
    return np.abs(x - np.round(x))


PATTERNS: tuple[Pattern, ...] = (bands, stripes, dots, zigzag, emblem)


_GLAZES = ["#e9e4d8", "#2f5f8f", "#b5382f", "#d9a83a", "#4f7f6a", "#2b2b30", "#c98fa0", "#8fb0c0"]


def build(rng: np.random.Generator) -> list[Part]:
    """One cup with its handle at +X, sometimes on a saucer."""
    height = rng.uniform(0.65, 1.0)
    rim = rng.uniform(0.34, 0.48)
    foot = rim * rng.uniform(0.6, 1.02)
    belly = rng.uniform(-0.05, 0.12) * rim
    glaze, ink, second = rng.permutation(len(_GLAZES))[:3]
    colors = [vary_color(rng, [_GLAZES[i]], 0.08) for i in (glaze, ink, second)]
    low, high = np.sort(rng.uniform(0.15, 0.9, 2)) if rng.random() < 0.3 else (0.18, 0.82)
    pattern = PATTERNS[rng.integers(len(PATTERNS))]
    outside = Glaze(
        colors[0],
        colors[1],
        colors[2] if rng.random() < 0.4 else colors[0],
        pattern,
        int(rng.integers(6, 13)),
        low * height,
        max(high, low + 0.2) * height,
        rim,
    )
    gloss = rng.uniform(0.4, 0.9)
    inner = Material(
        Plain(colors[rng.integers(3)] if rng.random() < 0.5 else linear_color("#efeae0")), gloss
    )
    wall = rng.uniform(0.03, 0.05)
    profile = _profile(height, rim, foot, belly)
    parts = [
        Part(_outer(profile, wall), Material(outside, gloss, 80)),
        Part(_inner(profile, wall), inner),
    ]
    handle_color = colors[rng.choice([0, 0, 1, 2])]
    parts.append(Part(_handle(rng, profile, height), Material(Plain(handle_color), gloss, 80)))
    if rng.random() < 0.6:
        parts.append(_drink(rng, profile, wall, height))
    if rng.random() < 0.35:
        rise = 0.06
        parts = [Part(p.mesh, p.material, placement((0, 0, rise))) for p in parts]
        parts.append(_saucer(rng, rim, Material(Plain(colors[0]), gloss)))
    return parts


def _profile(height: Real, rim: Real, foot: Real, belly: Real) -> Float[np.ndarray, "k 2"]:
    t = np.linspace(0, 1, 14)
    radius = foot + (rim - foot) * t**0.7 + 4 * belly * t * (1 - t)
    return np.stack([radius, t * height], -1)


def _outer(profile: Float[np.ndarray, "k 2"], wall: Real) -> Mesh:
    """Foot, side and the rounded rim."""
    top = profile[-1]
    lip = top + wall * np.array([[-0.2, 0.35], [-0.5, 0.45]])
    return lathe(np.concatenate([[[0, 0]], profile, lip]), 48)


def _inner(profile: Float[np.ndarray, "k 2"], wall: Real) -> Mesh:
    top = profile[-1] + wall * np.array([-0.5, 0.45])
    side = (profile - [wall, 0])[::-1]
    side = side[side[:, 1] > wall * 1.5]
    return lathe(np.concatenate([[top], side, [[0, wall * 1.5]]]), 40)


def _handle(rng: np.random.Generator, profile: Float[np.ndarray, "k 2"], height: Real) -> Mesh:
    """A loop, round, square-ish or ear-shaped."""
    low, high = rng.uniform(0.15, 0.3) * height, rng.uniform(0.72, 0.88) * height
    reach = rng.uniform(0.2, 0.32)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 18)
    power = rng.uniform(0.45, 1.0)
    out = np.abs(np.cos(angle)) ** power * reach
    z = (low + high) / 2 + np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** power * (
        high - low
    ) / 2
    wall = np.interp(z, profile[:, 1], profile[:, 0]) - 0.015
    drop = rng.uniform(0.0, 0.25) * out * (angle < 0)
    path = np.stack([wall + out, np.zeros_like(z), z + drop], -1)
    return sweep(path, rng.uniform(0.035, 0.055), 12, flatten=rng.uniform(0.7, 1.3))


def _drink(
    rng: np.random.Generator, profile: Float[np.ndarray, "k 2"], wall: Real, height: Real
) -> Part:
    level = height * rng.uniform(0.7, 0.9)
    radius = np.interp(level, profile[:, 1], profile[:, 0]) - wall * 0.8
    color = vary_color(rng, ["#3a2012", "#7a4a22", "#a8702f", "#cdbb9c"])
    disc = lathe([[radius, level], [0, level]], 32)
    return Part(disc, Material(Mottled(color * 0.8, color * 1.2, 5.0, draw_seed(rng)), 0.8, 120))


def _saucer(rng: np.random.Generator, rim: Real, glaze: Material) -> Part:
    wide = rim * rng.uniform(1.45, 1.75)
    profile = [
        [0, 0.0],
        [wide * 0.5, 0.0],
        [wide, 0.1],
        [wide, 0.12],
        [wide * 0.55, 0.05],
        [0, 0.045],
    ]
    return Part(lathe(profile, 40), glaze)
