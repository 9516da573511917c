"""Books: lying, standing ajar, or stacked, with printed covers, lettered spines and page blocks."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from extrap_train.data.synthetic.ground import draw_seed
from extrap_train.data.synthetic.kernels import Real, fractal_noise
from extrap_train.data.synthetic.material import (
    Color,
    LocalPoints,
    Material,
    Numbers,
    mix,
    step,
    vary_color,
)
from extrap_train.data.synthetic.parts import Part, placement
from extrap_train.data.synthetic.shapes import rounded_box

PLACES = (0.15, 0.2, 0.65)
"""How likely one is found outdoors, on a floor, on a table."""


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

    def __call__(self, surface: LocalPoints) -> Float[np.ndarray, "n 3"]:
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

    def __call__(self, surface: LocalPoints) -> Float[np.ndarray, "n 3"]:
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

    def __call__(self, surface: LocalPoints) -> Float[np.ndarray, "n 3"]:
        """Reflectance in linear light."""
        layered = surface.points * np.array([1.5, 1.5, 40], np.float32)
        lines = fractal_noise(layered, surface.footprint * 10, 1.0, 2, 11)
        return mix(self.paper * 0.6, self.paper, 0.6 + lines)


def _lettering(
    u: Numbers, v: Numbers, rows: int, pitch: Real, half_width: Real, seed: int, blur: Numbers
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


_CLOTHS = [
    "#8f2a2a",
    "#274a7a",
    "#2f6b4a",
    "#d9b24a",
    "#e6dfd0",
    "#3a3540",
    "#c8663a",
    "#5f4a86",
    "#4a9aa8",
]


def build(rng: np.random.Generator) -> list[Part]:
    """A lying book, a stack, or one that stands a little open."""
    match rng.choice(3, p=[0.35, 0.3, 0.35]):
        case 0:
            return _lying(rng, 0.0, 1.0, rng.uniform(0, 2 * np.pi))[0]
        case 1:
            parts: list[Part] = []
            base, scale = 0.0, 1.0
            for _ in range(int(rng.integers(2, 4))):
                book, top = _lying(rng, base, scale, rng.uniform(-0.5, 0.5))
                parts += book
                base, scale = top, scale * rng.uniform(0.8, 0.98)
            return parts
        case _:
            return _standing(rng)


@dataclass(frozen=True)
class _Binding:
    """A book's looks and measures."""

    width: Real
    height: Real
    thickness: float
    cover: Material
    spine: Material
    pages: Material


def _binding(rng: np.random.Generator, scale: Real) -> _Binding:
    height = scale
    width = height * rng.uniform(0.64, 0.85)
    thickness = rng.uniform(0.14, 0.28) * scale
    ground, ink, second = (vary_color(rng, [_CLOTHS[i]], 0.08) for i in rng.permutation(9)[:3])
    gloss = rng.uniform(0.0, 0.35)
    cover = Cover(
        ground, ink, second, (width, height), int(rng.integers(4)),
        float(rng.choice([-0.28, 0.28])), bool(rng.random() < 0.5), draw_seed(rng),
    )  # fmt: skip
    spine = Spine(ground if rng.random() < 0.7 else second, ink, height, draw_seed(rng))
    paper = Pages(vary_color(rng, ["#efe8d6", "#e3d6b8", "#f4f1ea"], 0.05))
    return _Binding(
        width, height, thickness, Material(cover, gloss), Material(spine, gloss), Material(paper)
    )


def _lying(
    rng: np.random.Generator, base: Real, scale: Real, turn: Real
) -> tuple[list[Part], float]:
    """A closed book, its front up, and the height of its top; the spine is at −X."""
    book = _binding(rng, scale)
    board = 0.022 * scale
    cover = rounded_box((book.width, book.height, board), board * 0.4, 1)
    block = rounded_box((book.width * 0.95, book.height * 0.95, book.thickness - 2 * board))
    spine = rounded_box((board * 1.4, book.height, book.thickness), board * 0.6, 2)
    middle = base + book.thickness / 2
    along, across = np.cos(turn), np.sin(turn)
    back = book.width / 2 - board * 0.2
    at = (-along * back, -across * back, middle)
    inward = (-along * 0.012, -across * 0.012, middle)
    parts = [
        Part(cover, book.cover, placement((0, 0, base + book.thickness - board / 2), turn)),
        Part(cover, book.cover, placement((0, 0, base + board / 2), turn)),
        Part(block, book.pages, placement(inward, turn)),
        Part(spine, book.spine, placement(at, turn)),
    ]
    return parts, base + book.thickness


def _standing(rng: np.random.Generator) -> list[Part]:
    """A book on its lower edge, its covers spread around the spine, pages fanned between them."""
    book = _binding(rng, 1.0)
    board, spread = 0.022, rng.uniform(0.35, 1.2)
    cover = rounded_box((book.width, book.height, board), board * 0.4, 1)
    sheet = rounded_box((book.width * 0.94, book.height * 0.95, 0.03), 0.004, 1)
    shares = np.linspace(-0.8, 0.8, int(rng.integers(4, 8)))
    covers = [Part(cover, book.cover, _upright(book, side * spread / 2)) for side in (-1, 1)]
    pages = [Part(sheet, book.pages, _upright(book, share * spread / 2)) for share in shares]
    thick = book.width * 2 * np.sin(spread / 2) * 0.06 + 0.05
    spine = rounded_box((0.04, book.height, thick), 0.015, 2)
    return [*covers, *pages, Part(spine, book.spine, _upright(book, 0.0, share=0.0))]


def _upright(book: _Binding, angle: Real, share: Real = 0.5) -> np.ndarray:
    """A leaf's pose: local Y up, local X away from the spine; fronts face negative angles."""
    out = np.array([np.cos(angle), np.sin(angle), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([out, up, np.cross(out, up)], -1)
    matrix[:3, 3] = out * book.width * share + up * book.height / 2
    return matrix
