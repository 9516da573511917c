"""Printed matter: book covers, spines and the edges of pages."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from extrap_train.data.synthetic.material import Color, Numbers, Surface, mix, step
from extrap_train.data.synthetic.noise import fractal_noise
from extrap_train.data.synthetic.vectors import Real


@dataclass(frozen=True)
class Cover:
    """A printed cover: ground, border, title lines, and an emblem; the back has a paragraph."""

    ground: Color
    ink: Color
    second: Color
    size: tuple[Real, Real]
    """Width (local X) and height (local Y)."""
    emblem: int
    """0 a disc, 1 a triangle, 2 diagonal stripes, 3 two blocks."""
    title_at: Real
    """Height of the title on the cover, -0.5 … 0.5."""
    border: bool
    seed: int

    def __call__(self, surface: Surface) -> Float[np.ndarray, "n 3"]:
        """Reflectance in linear light."""
        x, y, _ = surface.points.T
        width, height = self.size
        u, v, blur = x / width, y / height, surface.footprint / width
        front = surface.normals[:, 2] > 0
        worn = fractal_noise(surface.points, surface.footprint, 6.0, 3, self.seed)
        color = mix(self.ground * 0.85, self.ground * 1.1, 0.5 + worn)
        if self.border:
            edge = 0.46 - np.maximum(np.abs(u), np.abs(v))
            color = mix(color, self.ink, step(edge, blur) * step(0.03 - edge, blur))
        picture = self._picture(u, v - (0.12 if self.title_at < 0 else -0.12), blur)
        color = mix(color, self.second, picture * front)
        title = _lettering(u, (v - self.title_at) * height / width, 2, 0.13, 0.36, self.seed, blur)
        blurb = _lettering(u, (v - 0.1) * height / width, 6, 0.06, 0.36, self.seed + 3, blur)
        return mix(color, self.ink, np.where(front, title, blurb))

    def _picture(self, u: Numbers, v: Numbers, blur: Numbers) -> Numbers:
        match self.emblem:
            case 0:
                return step(0.27 - np.hypot(u, v * self.size[1] / self.size[0]), blur)
            case 1:
                return step(v + 0.2, blur) * step(0.3 - np.abs(u) - (v + 0.2) * 0.8, blur)
            case 2:
                wave = (u + v) * 5
                inside = step(0.3 - np.maximum(np.abs(u), np.abs(v)), blur)
                return inside * step(np.abs(wave - np.round(wave)) / 5 - 0.05, blur)
            case _:
                return step(0.38 - np.abs(u), blur) * step(0.16 - np.abs(v), blur)


@dataclass(frozen=True)
class Spine:
    """Cloth with the title along local Y and two bands."""

    ground: Color
    ink: Color
    length: Real
    seed: int

    def __call__(self, surface: Surface) -> Float[np.ndarray, "n 3"]:
        """Reflectance in linear light."""
        v = surface.points[:, 1] / self.length
        w = surface.points[:, 2]
        blur = surface.footprint / self.length
        bands = step(0.02 - np.abs(np.abs(v) - 0.4), blur)
        title = _lettering(v, w * 6, 1, 0.3, 0.3, self.seed, blur)
        return mix(
            np.broadcast_to(self.ground, surface.points.shape), self.ink, np.maximum(bands, title)
        )


@dataclass(frozen=True)
class Pages:
    """The edges of many sheets, stacked along local Z."""

    paper: Color

    def __call__(self, surface: Surface) -> Float[np.ndarray, "n 3"]:
        """Reflectance in linear light."""
        layered = surface.points * np.array([1.5, 1.5, 40], np.float32)
        lines = fractal_noise(layered, surface.footprint * 10, 1.0, 2, 11)
        return mix(self.paper * 0.6, self.paper, 0.6 + lines)


def _lettering(
    u: Numbers,
    v: Numbers,
    rows: int,
    pitch: Real,
    half_width: Real,
    seed: int,
    blur: Numbers,
) -> Numbers:
    """Rows of dashes like words seen from afar, centred at (0, 0), `pitch` apart."""
    line = np.floor(rows / 2 - v / pitch)
    inside = (line >= 0) & (line < rows)
    v_in_row = np.abs((rows / 2 - v / pitch) - line - 0.5)
    mixed = np.sin(line * 91.7 + seed % 997) * 437.5
    random = mixed - np.floor(mixed)
    reach = half_width * (0.55 + 0.45 * random)
    letters = u / (pitch * 0.55) + 7 * random
    gap = np.abs(letters - np.round(letters)) * pitch * 0.55
    kept = np.clip(1.5 - 2 * blur / (pitch * 0.55), 0, 1)
    marks = 1 - step(0.07 * pitch - gap, blur) * kept
    return inside * step((0.32 - v_in_row) * pitch, blur) * step(reach - np.abs(u), blur) * marks
