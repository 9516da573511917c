"""Fire hydrants: flanged base, barrel, capped nozzles, bonnet with its nut; weathered paint."""

import numpy as np

from extrap_train.data.synthetic.ground import draw_seed
from extrap_train.data.synthetic.kernels import Real
from extrap_train.data.synthetic.material import (
    Color,
    Material,
    Mottled,
    Worn,
    linear_color,
    vary_color,
)
from extrap_train.data.synthetic.parts import Part, placement
from extrap_train.data.synthetic.shapes import Mesh, lathe, merge, move_mesh, sweep

PLACES = (1.0, 0.0, 0.0)
"""How likely one is found outdoors, on a floor, on a table."""

_PAINTS = ["#c2261f", "#d9b21f", "#2f5fa8", "#b4b8bb", "#dedcd2", "#3f7f4a", "#d9701f"]


def build(rng: np.random.Generator) -> list[Part]:
    """One hydrant of height 1."""
    body, cap = rng.permutation(len(_PAINTS))[:2]
    cap = body if rng.random() < 0.25 else cap
    iron = _paint(rng, vary_color(rng, [_PAINTS[body]], 0.08))
    contrast = _paint(rng, vary_color(rng, [_PAINTS[cap]], 0.08))
    radius, shoulder = rng.uniform(0.13, 0.18), rng.uniform(0.6, 0.7)
    nozzle_height = shoulder - rng.uniform(0.1, 0.17)
    parts = [
        Part(_barrel(rng, radius, shoulder), iron),
        Part(_bolts(rng, radius), _paint(rng, linear_color("#5a5450"))),
        Part(_bonnet(rng, radius, shoulder), contrast),
    ]
    sides = [0.0, np.pi] if rng.random() < 0.85 else [0.0]
    parts += _nozzles(rng, radius, nozzle_height, sides, 1.0, iron, contrast)
    if rng.random() < 0.8:
        low = nozzle_height - rng.uniform(0.0, 0.06)
        parts += _nozzles(rng, radius, low, [np.pi / 2], rng.uniform(1.25, 1.6), iron, contrast)
    if rng.random() < 0.4:
        parts.append(_chain(rng, radius, nozzle_height))
    if rng.random() < 0.35:
        ring = np.array([[1.0, 0.0], [1.0, 1.0]]) * [radius + 0.004, rng.uniform(0.05, 0.1)]
        dark, pale = (vary_color(rng, ["#e8e6dc", "#1f1f22"]) for _ in range(2))
        band = Material(Mottled(dark * 0.85, pale, 8.0, 1))
        parts.append(Part(lathe(ring, 28), band, placement((0, 0, rng.uniform(0.2, 0.32)))))
    return parts


def _paint(rng: np.random.Generator, color: Color) -> Material:
    """Painted cast iron: chips of rust, dirt near the ground."""
    coat = Mottled(color * 0.8, color * 1.08, 6.0, draw_seed(rng), 3)
    rust = vary_color(rng, ["#6b3f26", "#4a3a30", "#7a5a3a"])
    worn = Worn(coat, rust, rng.uniform(0.1, 0.6), rng.uniform(5, 9), draw_seed(rng), 0.18)
    return Material(worn, rng.uniform(0.1, 0.5), rng.uniform(15, 50), 0.12, 30.0)


def _barrel(rng: np.random.Generator, radius: Real, shoulder: Real) -> Mesh:
    flange, ring = radius + rng.uniform(0.06, 0.1), radius + rng.uniform(0.025, 0.05)
    low = rng.uniform(0.1, 0.16)
    waist = radius * rng.uniform(0.86, 1.0)
    profile = [
        [0, 0], [flange, 0], [flange, 0.045], [radius + 0.02, 0.05], [waist, low],
        [ring, low + 0.005], [ring, low + 0.035], [waist, low + 0.04], [waist, shoulder - 0.24],
        [radius, shoulder - 0.2], [radius, shoulder - 0.03], [ring + 0.01, shoulder - 0.02],
        [ring + 0.01, shoulder + 0.01], [0, shoulder + 0.01],
    ]  # fmt: skip
    return lathe(profile, 32)


def _bolts(rng: np.random.Generator, radius: Real) -> Mesh:
    """A ring of bolts on the base flange."""
    bolt = lathe([[0.022, 0.04], [0.022, 0.075], [0, 0.08]], 6)
    count = int(rng.integers(5, 9))
    turns = np.arange(count) * 2 * np.pi / count
    spots = [(float(np.cos(t)), float(np.sin(t))) for t in turns]
    far = radius + 0.045
    return merge([move_mesh(bolt, placement((far * x, far * y, 0.0))) for x, y in spots])


def _bonnet(rng: np.random.Generator, radius: Real, shoulder: Real) -> Mesh:
    """A dome, a bell or a stepped cap, with the operating nut on top."""
    rim, height = radius + rng.uniform(0.03, 0.06), rng.uniform(0.16, 0.24)
    roundness = rng.uniform(0.7, 1.5)
    t = np.linspace(0, 1, 9)[:-1]
    base = shoulder + 0.01
    across = 0.95 * radius * np.cos(t * np.pi / 2) ** roundness
    dome = np.stack([across, height * np.sin(t * np.pi / 2) + (base + 0.031)], -1)
    profile = np.concatenate([[[rim, base], [rim, base + 0.03]], dome])
    top = base + 0.031 + height
    nut = np.array(
        [
            [0.045, top - 0.03],
            [0.045, top + 0.0],
            [0.03, top + 0.005],
            [0.03, top + 0.06],
            [0, top + 0.06],
        ]
    )
    return merge([lathe(profile, 32), lathe(nut, int(rng.choice([5, 6])))])


def _nozzles(
    rng: np.random.Generator,
    radius: Real,
    height: Real,
    turns: list[Real],
    size: Real,
    iron: Material,
    cap: Material,
) -> list[Part]:
    """Outlets with their caps, pointing along each turn from −Y."""
    pipe = radius + rng.uniform(0.035, 0.06)
    bore = 0.058 * size
    neck = lathe(
        [[bore, 0], [bore, pipe - 0.01], [bore * 1.25, pipe - 0.01], [bore * 1.25, pipe + 0.015]],
        20,
    )
    lid = [
        [bore * 1.15, pipe + 0.01],
        [bore * 1.15, pipe + 0.05],
        [bore * 0.9, pipe + 0.065],
        [0, pipe + 0.07],
    ]
    nut = [[0.024 * size, pipe + 0.06], [0.02 * size, pipe + 0.105], [0, pipe + 0.105]]
    caps = merge([lathe(lid, int(rng.choice([8, 20]))), lathe(nut, 5)])
    parts = []
    for turn in turns:
        pose = placement((0, 0, height), turn + np.pi / 2, np.pi / 2)
        parts += [Part(neck, iron, pose), Part(caps, cap, pose)]
    return parts


def _chain(rng: np.random.Generator, radius: Real, height: Real) -> Part:
    """A sagging chain from one cap to the front."""
    t = np.linspace(0, 1, 14)
    angle = t * np.pi / 2
    far = radius + 0.05 + 0.02 * np.sin(np.pi * t)
    sag = height - 0.02 - 4 * rng.uniform(0.06, 0.14) * t * (1 - t)
    path = np.stack([far * np.cos(angle), far * np.sin(angle), sag], -1)
    beads = 0.009 + 0.005 * (np.arange(14) % 2)
    steel = Material(Mottled(np.full(3, 0.1), np.full(3, 0.3), 20.0, draw_seed(rng)), 0.4)
    return Part(sweep(path, beads, 6), steel)
