"""What a surface looks like: solid textures in linear light, evaluated where a ray hits."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from extrap_train.data.synthetic.kernels import Real, fractal_noise

Color = Float[np.ndarray, " 3"]
Numbers = Float[np.ndarray, " n"]
"""One a point."""
_RINGS = 9.0
"""Growth rings of wood per unit length."""
_BAND = 0.4
"""Share of a plaid's period that a band takes."""


@dataclass(frozen=True)
class LocalPoints:
    """Where rays hit one part, in the part's own coordinates."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    footprint: Float[np.ndarray, " n"]
    """Width of a pixel on the surface."""

    def planar(self) -> Float[np.ndarray, "n 2"]:
        """Coordinates along the box side that the normal leaves; the second is z on a wall."""
        axis = np.abs(self.normals).argmax(1)
        x, y, z = self.points.T
        return np.stack([np.where(axis == 0, y, x), np.where(axis == 2, y, z)], -1)


@runtime_checkable
class Texture(Protocol):
    """A colour for every point of a surface."""

    def __call__(self, surface: LocalPoints) -> Float[np.ndarray, "n 3"]:
        """Reflectance in linear light, 0 … 1."""
        ...


@dataclass(frozen=True)
class Material:
    """A texture and how it answers light."""

    texture: Texture
    gloss: Real = 0.0
    """Strength of the highlight."""
    shininess: Real = 60.0
    """Blinn-Phong exponent."""
    roughness: Real = 0.0
    """How far fine noise tilts the normals."""
    roughness_frequency: Real = 20.0
    glow: Real = 0.0
    """Share of the colour that shines by itself (sky, lamps)."""


def linear_color(code: str) -> Color:
    """The linear-light colour of a `#rrggbb` code."""
    encoded = np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return srgb_to_linear(encoded)


def srgb_to_linear(encoded: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """IEC 61966-2-1, decoding."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """IEC 61966-2-1, encoding; `linear` within 0 … 1."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def vary_color(rng: np.random.Generator, codes: list[str], spread: Real = 0.12) -> Color:
    """One of the colours, a little lighter, darker or tinted."""
    color = linear_color(codes[rng.integers(len(codes))])
    tint = rng.normal(0, spread / 2, 3) + rng.normal(0, spread)
    return np.clip(color * np.exp(tint), 0.01, 0.95)


def mix(a: np.ndarray, b: np.ndarray, share: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """From `a` (share 0) to `b` (share 1); each a colour or one colour per point."""
    t = np.clip(share, 0, 1).astype(np.float32)[:, None]
    low, high = np.asarray(a, np.float32), np.asarray(b, np.float32)
    return low + (high - low) * t


def step(x: Float[np.ndarray, " n"], footprint: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """0 for x < 0 and 1 for x > 0, with an edge as wide as a pixel."""
    return np.clip(x / np.maximum(footprint, 1e-6) + 0.5, 0, 1)


@dataclass(frozen=True)
class Plain:
    """One colour."""

    color: Color

    def __call__(self, surface: LocalPoints) -> Float[np.ndarray, "n 3"]:
        """Reflectance in linear light."""
        return np.broadcast_to(self.color, surface.points.shape)


@dataclass(frozen=True)
class Mottled:
    """Two colours blended by noise: plaster, grass, stone, fur; stretched: brushed or grained."""

    low: Color
    high: Color
    frequency: Real
    seed: int
    octaves: int = 3
    contrast: Real = 1.0
    stretch: tuple[Real, Real, Real] = (1.0, 1.0, 1.0)

    def __call__(self, surface: LocalPoints) -> Float[np.ndarray, "n 3"]:
        """Reflectance in linear light."""
        points = surface.points * np.array(self.stretch, np.float32)
        footprint = surface.footprint * np.float32(min(self.stretch))
        noise = fractal_noise(points, footprint, self.frequency, self.octaves, self.seed)
        return mix(self.low, self.high, 0.5 + self.contrast * noise)


@dataclass(frozen=True)
class Wood:
    """Growth rings of a trunk along +Z, wavered by noise."""

    low: Color
    high: Color
    seed: int

    def __call__(self, surface: LocalPoints) -> Float[np.ndarray, "n 3"]:
        """Reflectance in linear light."""
        stretch = np.array([1, 1, 0.15], np.float32)
        points = surface.points * stretch + np.array([0.37, 0.21, 0.13], np.float32)
        radius = np.hypot(points[:, 0], points[:, 1])
        waver = fractal_noise(points, surface.footprint, _RINGS / 3, 2, self.seed)
        fine = fractal_noise(points, surface.footprint, _RINGS * 3, 2, self.seed + 7)
        phase = radius * _RINGS + waver * 1.5
        kept = np.clip(1.2 - surface.footprint * _RINGS * 2, 0, 1)
        rings = 0.5 + 0.5 * np.sin(2 * np.pi * phase) * kept
        return mix(self.low, self.high, 0.75 * rings + 0.5 * fine)


@dataclass(frozen=True)
class Tiling:
    """Rectangles with joints over the box sides: pavement, bricks, floorboards, window grids."""

    inside: Texture
    joint: Color
    size: tuple[Real, Real]
    seed: int
    joint_width: Real = 0.03
    offset: Real = 0.0
    """Shift of every other row, as a share of a tile."""
    shades: Real = 0.25
    """Spread of the tiles' brightness."""
    second: Color | None = None
    """Every other tile in this colour, as on a chessboard."""

    def __call__(self, surface: LocalPoints) -> Float[np.ndarray, "n 3"]:
        """Reflectance in linear light."""
        x, y = surface.planar().T
        row = np.floor(y / self.size[1])
        x = x + self.offset * self.size[0] * (row % 2)
        column = np.floor(x / self.size[0])
        to_edge = np.minimum(_edge_distance(x, self.size[0]), _edge_distance(y, self.size[1]))
        mixed = np.sin(column * 127.1 + row * 311.7 + self.seed % 1000) * 43758.5
        shade = 1 + self.shades * (2 * (mixed - np.floor(mixed)) - 1)
        blur = np.clip(1.5 - 2 * surface.footprint / min(self.size), 0, 1)
        color = self.inside(surface)
        if self.second is not None:
            color = mix(color, self.second, ((row + column) % 2) * blur + 0.5 * (1 - blur))
        color = color * (1 + (shade - 1) * blur)[:, None]
        share = step(self.joint_width / 2 - to_edge, surface.footprint)
        mean = np.clip(self.joint_width / min(self.size) * 1.5, 0, 1)
        return mix(color, self.joint, share * blur + mean * (1 - blur))


def _edge_distance(x: Float[np.ndarray, " n"], period: float) -> Float[np.ndarray, " n"]:
    """Distance to the nearest multiple of `period`."""
    phase = x / period
    return np.abs(phase - np.round(phase)) * period


@dataclass(frozen=True)
class Plaid:
    """Crossing bands of woven cloth."""

    base: Color
    warp: Color
    weft: Color
    period: Real

    def __call__(self, surface: LocalPoints) -> Float[np.ndarray, "n 3"]:
        """Reflectance in linear light."""
        x, y = surface.planar().T
        kept = np.clip(1.5 - 2 * surface.footprint / self.period, 0, 1)
        half = _BAND * self.period / 2
        bands = [
            step(half - _edge_distance(t, self.period), surface.footprint) * kept
            + _BAND * (1 - kept)
            for t in (x, y)
        ]
        return mix(mix(self.base, self.warp, 0.6 * bands[0]), self.weft, 0.6 * bands[1])


@dataclass(frozen=True)
class Worn:
    """Another texture with patches of rust, dirt or stains that gather towards the bottom."""

    under: Texture
    stain: Color
    amount: Real
    """0 is spotless, 1 about half covered."""
    frequency: Real
    seed: int
    low_height: Real = 0.25
    """Height below which dirt gathers."""

    def __call__(self, surface: LocalPoints) -> Float[np.ndarray, "n 3"]:
        """Reflectance in linear light."""
        noise = fractal_noise(surface.points, surface.footprint, self.frequency, 3, self.seed)
        height = np.clip(1 - surface.points[:, 2] / self.low_height, 0, 1)
        share = (noise - 0.75 + self.amount * (0.6 + 0.6 * height)) * 5
        return mix(self.under(surface), self.stain, np.clip(share, 0, 0.85))
