"""Apples: dimpled, lobed, blushed and streaked, with a stem and sometimes a leaf."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from extrap_train.data.synthetic.ground import draw_seed
from extrap_train.data.synthetic.kernels import fractal_noise
from extrap_train.data.synthetic.material import (
    Color,
    LocalPoints,
    Material,
    Mottled,
    linear_color,
    mix,
    vary_color,
)
from extrap_train.data.synthetic.parts import Part, placement
from extrap_train.data.synthetic.shapes import Mesh, displace, lathe, sheet, sweep

PLACES = (0.2, 0.0, 0.8)
"""How likely one is found outdoors, on a floor, on a table."""


@dataclass(frozen=True)
class AppleSkin:
    """A ground colour, a blush on the sunny side, streaks from pole to pole, pale dots."""

    base: Color
    blush: Color
    sunny_side: Float[np.ndarray, " 3"]
    blush_size: float
    """-1 none … 1 all over."""
    streaks: float
    dots: float
    seed: int

    def __call__(self, surface: LocalPoints) -> Float[np.ndarray, "n 3"]:
        """Reflectance in linear light."""
        points, footprint = surface.points, surface.footprint
        radius = np.hypot(points[:, 0], points[:, 1]) + 1e-4
        around = np.stack(
            [points[:, 0] / radius, points[:, 1] / radius, 0.25 * points[:, 2]], -1
        ).astype(np.float32)
        streak = fractal_noise(around, footprint / radius, 7.0, 3, self.seed)
        cloud = fractal_noise(points, footprint, 2.5, 2, self.seed + 9)
        toward = 2 * (points * self.sunny_side.astype(np.float32)).sum(1)
        share = 0.5 + 1.3 * (toward + self.blush_size) + 0.5 * cloud + self.streaks * streak
        color = mix(self.base, self.blush, share)
        dots = fractal_noise(points, footprint, 22.0, 1, self.seed + 20)
        color = mix(color, np.array([0.75, 0.62, 0.35], np.float32), self.dots * (dots - 0.45) * 6)
        poles = np.clip(1 - radius / 0.16, 0, 1) * (0.7 + 0.5 * streak)
        return mix(color, linear_color("#8a7a3a"), poles)


def build(rng: np.random.Generator) -> list[Part]:
    """One apple, upright or tilted."""
    tilt = rng.choice([0.0, 1.0], p=[0.35, 0.65]) * rng.uniform(0.2, 1.2)
    pose = placement(turn_rad=rng.uniform(0, 2 * np.pi), tilt_rad=tilt)
    base, blush = _variety(rng)
    sunny = rng.normal(size=3) * [1, 1, 0.5]
    skin = AppleSkin(
        base,
        blush,
        sunny / np.linalg.norm(sunny),
        rng.uniform(-0.7, 0.7),
        rng.uniform(0.2, 1.5),
        rng.uniform(0, 1),
        draw_seed(rng),
    )
    body, top = _body(rng)
    parts = [Part(body, Material(skin, rng.uniform(0.3, 0.7), rng.uniform(20, 70)), pose)]
    lean = rng.uniform(-0.12, 0.12, 2)
    length = rng.uniform(0.2, 0.36)
    path = [[*(lean * t * t), top + 0.02 + length * t] for t in np.linspace(0, 1, 6)]
    bark = vary_color(rng, ["#5a4027", "#6e5a34", "#46351f"])
    stem = sweep(path, np.linspace(0.018, 0.028, 6), 8)
    parts.append(Part(stem, Material(Mottled(bark * 0.6, bark * 1.4, 12.0, draw_seed(rng))), pose))
    if rng.random() < 0.5:
        green = vary_color(rng, ["#4f7f2f", "#6f9a3f", "#3f6a35"])
        leaf = Material(Mottled(green * 0.7, green * 1.3, 9.0, draw_seed(rng)), 0.25)
        parts.append(Part(_leaf(rng, np.array(path[3])), leaf, pose))
    return parts


def _variety(rng: np.random.Generator) -> tuple[Color, Color]:
    """Ground colour and blush."""
    bases = [["#d8b84a", "#d9a441"], ["#8fae3a", "#a5b84c"], ["#b3302a", "#8f1f24"], ["#cfc25a"]]
    blushes = [["#b3272a", "#c8432f"], ["#c2a23f", "#a8523a"], ["#5f1220", "#d2603a"], ["#d0703a"]]
    kind = rng.integers(len(bases))
    return vary_color(rng, bases[kind]), vary_color(rng, blushes[kind])


def _body(rng: np.random.Generator) -> tuple[Mesh, float]:
    """The fruit, and the height of the cavity that the stem grows from."""
    polar = np.linspace(np.pi, 0, 40)
    top, bottom = rng.uniform(0.3, 0.5), rng.uniform(0.15, 0.35)
    distance = 0.5 * (1 - top * np.exp(-((polar / 0.42) ** 2)))
    distance -= 0.5 * bottom * np.exp(-(((np.pi - polar) / 0.33) ** 2))
    radius = distance * np.sin(polar) * (1 + rng.uniform(0.0, 0.22) * np.cos(polar))
    height = distance * np.cos(polar) * rng.uniform(0.84, 1.12)
    smooth = lathe(np.stack([np.abs(radius), height], -1), 48)
    x, y, z = smooth.vertices.T
    lobes = np.cos(5 * np.arctan2(y, x) + rng.uniform(0, 6)) * rng.uniform(0, 0.05)
    swell = lobes * (0.3 - z) + 0.06 * rng.normal() * x + 0.05 * rng.normal() * y
    offset = np.stack([x * swell, y * swell, np.zeros_like(z)], -1)
    return displace(smooth, offset), float(height[-1])


def _leaf(rng: np.random.Generator, root: Float[np.ndarray, " 3"]) -> Mesh:
    """A pointed, folded and drooping leaf."""
    length, turn = rng.uniform(0.35, 0.55), rng.uniform(0, 2 * np.pi)
    along, across = np.meshgrid(np.linspace(0, 1, 10), np.linspace(-1, 1, 7), indexing="ij")
    width = 0.3 * length * np.sin(np.pi * along**0.8) * across
    rise = 0.35 * length * (along - 1.2 * along**2) + 0.4 * np.abs(width)
    flat = along * length
    x = np.cos(turn) * flat - np.sin(turn) * width
    y = np.sin(turn) * flat + np.cos(turn) * width
    return sheet(np.stack([x, y, rise], -1) + root)
