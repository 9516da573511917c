"""Books: lying, standing ajar, or stacked, with printed covers, lettered spines and page blocks."""

from dataclasses import dataclass

import numpy as np

from extrap_train.data.synthetic.ground import draw_seed
from extrap_train.data.synthetic.lettering import Cover, Pages, Spine
from extrap_train.data.synthetic.material import Material, vary_color
from extrap_train.data.synthetic.parts import Part, placement
from extrap_train.data.synthetic.shapes import rounded_box
from extrap_train.data.synthetic.vectors import Real

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
