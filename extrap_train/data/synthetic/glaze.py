"""Patterns around glazed pottery."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from extrap_train.data.synthetic.material import Color, Numbers, Surface, mix, step
from extrap_train.data.synthetic.vectors import Real


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

    def __call__(self, surface: Surface) -> Float[np.ndarray, "n 3"]:
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
