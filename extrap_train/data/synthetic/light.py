"""Light of a scene: one sun (or lamp), a sky and what the ground throws back."""

from dataclasses import dataclass

import numpy as np
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float

from extrap_train.data.synthetic.shapes import Mesh

_DIRECTIONS = 40
_EXPOSURE = 1.3


@dataclass(frozen=True)
class Light:
    """Irradiances in linear RGB, relative to what makes a white wall white."""

    to_sun: Float[np.ndarray, " 3"]
    """Unit vector in the world."""
    sun: Float[np.ndarray, " 3"]
    sky: Float[np.ndarray, " 3"]
    ground: Float[np.ndarray, " 3"]
    """Light from below, reflected by the ground."""


def draw_light(rng: np.random.Generator, indoors: bool) -> Light:
    """Daylight, or a softer and warmer room."""
    elevation, azimuth = rng.uniform(0.5, 1.15), rng.uniform(0, 2 * np.pi)
    across = np.cos(elevation)
    to_sun = np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])
    share = rng.uniform(0.25, 0.45) if indoors else rng.uniform(0.4, 0.6)
    warmth = rng.uniform(0.0, 0.12)
    sun = np.array([1 + warmth, 1.0, 1 - 1.6 * warmth]) * share * _EXPOSURE
    coolness = rng.uniform(-0.03, 0.04) if indoors else rng.uniform(0.0, 0.1)
    sky = np.array([1 - coolness, 1.0, 1 + coolness]) * (1.05 - share) * _EXPOSURE
    ground = sky * rng.uniform(0.3, 0.5)
    return Light(*(x.astype(np.float32) for x in (to_sun, sun, sky, ground)))


def ambient_light(mesh: Mesh, light: Light, casters: EmbreeScene) -> Float[np.ndarray, "v 3"]:
    """Irradiance at each vertex from sky and ground, less what the casters hide."""
    directions = _sphere(_DIRECTIONS)
    origins = (mesh.vertices + 0.004 * mesh.normals).astype(np.float32)
    cosines = np.maximum(np.einsum("vi,di->vd", mesh.normals, directions), 0)
    irradiance = np.zeros_like(mesh.vertices)
    for direction, cosine in zip(directions, cosines.T, strict=True):
        lit = np.flatnonzero(cosine > 0)
        rays = np.ascontiguousarray(np.broadcast_to(direction, (len(lit), 3)), np.float32)
        free = casters.run(origins[lit], rays, query="OCCLUDED") < 0
        source = light.sky if direction[2] > 0 else light.ground
        irradiance[lit] += (cosine[lit] * free)[:, None] * source
    # Bounced light reaches what the sky does not: nothing outdoors is black.
    total = cosines.sum(1, keepdims=True) + 1e-9
    return 0.82 * irradiance / total + 0.18 * light.sky


def _sphere(count: int) -> Float[np.ndarray, "n 3"]:
    """Evenly spread directions (a Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], -1)
