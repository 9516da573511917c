"""Teddy bears: sitting, furry, with ears, snout, eyes, belly patch, sometimes a bow or a shirt."""

import numpy as np

from extrap_train.data.synthetic.ground import CLOTHS, draw_seed
from extrap_train.data.synthetic.kernels import Real
from extrap_train.data.synthetic.material import (
    Color,
    Material,
    Mottled,
    Plaid,
    Plain,
    linear_color,
    vary_color,
)
from extrap_train.data.synthetic.parts import Part, placement
from extrap_train.data.synthetic.shapes import capsule, ellipsoid, merge, move_mesh, sweep, xyz

PLACES = (0.25, 0.4, 0.35)
"""How likely one is found outdoors, on a floor, on a table."""

_FURS = ["#8a5a32", "#b98a55", "#d9c49a", "#5c3a24", "#8f8a86", "#e3dccf", "#c98f9a", "#a8713f"]
_PADS = ["#d9c49a", "#f0e6d2", "#c9a070", "#e8cfc0", "#5a4030"]


def build(rng: np.random.Generator) -> list[Part]:
    """One bear that sits and looks along −Y."""
    fur_color = vary_color(rng, _FURS)
    fur, pad = _fur(rng, fur_color), _fur(rng, vary_color(rng, _PADS))
    limb = _fur(rng, vary_color(rng, _FURS)) if rng.random() < 0.2 else fur
    width, depth, height = rng.uniform(0.2, 0.27), rng.uniform(0.17, 0.22), rng.uniform(0.24, 0.3)
    belly = placement((0, 0, height))
    parts = [Part(ellipsoid((width, depth, height), 26, 0.92), fur, belly)]
    if rng.random() < 0.4:
        parts.append(_shirt(rng, (width, depth, height)))
    elif rng.random() < 0.75:
        patch = ellipsoid((width * 0.68, depth * 0.55, height * 0.7), 20)
        parts.append(Part(patch, pad, placement((0, -depth * 0.52, height * 0.98))))
    head_at = np.array([0.0, -0.02, 2 * height + rng.uniform(0.08, 0.13)])
    parts += _head(rng, head_at, fur, pad)
    parts += _limbs(rng, (width, depth, height), limb, pad)
    if rng.random() < 0.5:
        parts.append(_bow(rng, (0.0, -depth * 0.75, 2 * height - 0.06)))
    return parts


def _fur(rng: np.random.Generator, color: Color) -> Material:
    short = rng.uniform(14, 26)
    texture = Mottled(color * 0.55, color * 1.3, short, draw_seed(rng), 2, 0.7)
    return Material(texture, roughness=rng.uniform(0.4, 0.7), roughness_frequency=short)


def _head(rng: np.random.Generator, at: np.ndarray, fur: Material, pad: Material) -> list[Part]:
    radius = rng.uniform(0.19, 0.235)
    wide, long = rng.uniform(1.0, 1.15), rng.uniform(0.45, 0.62)
    parts = [Part(ellipsoid((radius * wide, radius * 0.92, radius), 26), fur, placement(at))]
    snout_at = at + xyz(0, -radius * 0.75, -radius * 0.25)
    snout = ellipsoid((radius * 0.48, radius * long, radius * 0.38), 18)
    parts.append(Part(snout, pad, placement(snout_at)))
    black = Material(Plain(linear_color("#17120f")), 0.9, 40)
    nose = ellipsoid((radius * 0.19, radius * 0.12, radius * 0.13), 12)
    parts.append(
        Part(nose, black, placement(snout_at + xyz(0, -radius * long * 0.92, radius * 0.2)))
    )
    eye = ellipsoid((0.028, 0.022, 0.03), 12)
    ear_size, spread = radius * rng.uniform(0.36, 0.5), rng.uniform(0.62, 0.8)
    ear = ellipsoid((ear_size, ear_size * 0.45, ear_size), 18)
    inner = ellipsoid((ear_size * 0.65, ear_size * 0.3, ear_size * 0.65), 14)
    for side in (-1, 1):
        eye_at = at + xyz(side * radius * 0.42, -radius * 0.82, radius * 0.2)
        parts.append(Part(eye, black, placement(eye_at)))
        ear_at = at + xyz(side * radius * wide * spread, 0, radius * 0.78)
        parts.append(Part(ear, fur, placement(ear_at)))
        parts.append(Part(inner, pad, placement(ear_at + xyz(0, -ear_size * 0.25, 0))))
    return parts


def _limbs(
    rng: np.random.Generator, body: tuple[Real, Real, Real], fur: Material, pad: Material
) -> list[Part]:
    width, depth, height = body
    arm, leg = rng.uniform(0.065, 0.085), rng.uniform(0.085, 0.11)
    parts = []
    for side in (-1, 1):
        shoulder = np.array([side * width * 0.8, -0.02, height * 1.55])
        hand = shoulder + xyz(
            side * rng.uniform(0.05, 0.2), -rng.uniform(0.08, 0.24), rng.uniform(-0.26, 0.1)
        )
        parts.append(Part(capsule(shoulder, hand, arm, arm * 1.1), fur))
        hip = np.array([side * width * 0.65, -depth * 0.3, leg])
        foot = hip + xyz(side * rng.uniform(0.06, 0.16), -rng.uniform(0.22, 0.32), 0.01)
        parts.append(Part(capsule(hip, foot, leg, leg * 1.08), fur))
        toward = (foot - hip) / np.linalg.norm(foot - hip)
        sole = ellipsoid((leg * 0.8, leg * 0.3, leg * 0.85), 16)
        turn = np.arctan2(toward[0], -toward[1])
        parts.append(Part(sole, pad, placement(foot + toward * leg * 0.9, turn)))
    return parts


def _shirt(rng: np.random.Generator, body: tuple[Real, Real, Real]) -> Part:
    """A knitted pullover over the upper body."""
    width, depth, height = (x * 1.05 for x in body)
    base, warp, weft = (vary_color(rng, CLOTHS) for _ in range(3))
    cloth = Plaid(base, warp, weft, rng.uniform(0.08, 0.16))
    shell = ellipsoid((width, depth, height * 0.72), 26, 0.9)
    return Part(shell, Material(cloth), placement((0, 0, body[2] * 1.2)))


def _bow(rng: np.random.Generator, at: tuple[Real, Real, Real]) -> Part:
    """A ribbon tied under the chin."""
    size = rng.uniform(0.07, 0.11)
    loop = ellipsoid((size, size * 0.45, size * 0.62), 14)
    loops = [move_mesh(loop, placement((side * size * 1.05, 0, 0))) for side in (-1, 1)]
    knot = ellipsoid((size * 0.35,) * 3, 12)
    tails = [
        sweep([[0, 0, 0], [x * 0.6, -0.02, -size], [x, -0.02, -size * 1.7]], 0.02, 6)
        for x in (-size, size)
    ]
    color = vary_color(rng, ["#b3272f", "#2f4fa0", "#d9b23a", "#2f7a4f", "#8a3f8f", "#e0e0dc"])
    return Part(merge([*loops, knot, *tails]), Material(Plain(color), 0.3), placement(at))
