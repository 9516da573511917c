"""Ground-truth points on the surfaces of a synthetic scene."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from extrap_train.data.synthetic.material import linear_to_srgb
from extrap_train.data.synthetic.scene import SyntheticScene
from extrap_train.data.synthetic.shading import radiance

_REACH = 1.5  # of the cloud, in object heights from the origin
_PIXEL_ANGLE = 0.004  # radians: textures are sampled as finely as a photograph shows them


@dataclass(frozen=True)
class SurfacePoints:
    """Points of the object and of what surrounds it, in the world."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    colors: Float[np.ndarray, "n 3"]
    """sRGB, 0 … 1, as seen from where the point was found."""
    is_object: Bool[np.ndarray, " n"]
    """Whether the point lies on the object, not on what surrounds it."""


def surface_points(scene: SyntheticScene, count: int) -> SurfacePoints:
    """Points spread evenly by area over what can be seen from outside within 1.5 of the origin.

    A point is kept where one of the eyes around the scene sees it: inner walls and undersides that
    touch the ground are left out.
    """
    rng = np.random.default_rng(count)
    mesh = scene.mesh
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    near = np.linalg.norm((a + b + c) / 3, axis=1) < _REACH
    face = rng.choice(len(area), 3 * count, p=area * near / (area * near).sum())
    u, v = rng.random((2, 3 * count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    points = a[face] * (1 - u - v) + b[face] * u + c[face] * v
    corners = mesh.normals[mesh.faces[face]]
    normals = corners[:, 0] * (1 - u[:, 0:1] - v) + corners[:, 1] * u + corners[:, 2] * v
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    eyes, seen = _eyes_that_see(scene, points)
    kept = np.flatnonzero(seen)[:count]
    points, normals, eyes = points[kept], normals[kept], eyes[kept].astype(np.float32)
    is_object = np.array([part.is_object for part in scene.parts])[scene.part_of_face[face[kept]]]
    light = radiance(scene, eyes, (points - eyes).astype(np.float32), _PIXEL_ANGLE)
    return SurfacePoints(points, normals, linear_to_srgb(light.clip(0, 1)), is_object)


def _eyes_that_see(
    scene: SyntheticScene, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """For each point one of 24 eyes on a hemisphere of radius 2.4 that sees it, if any does."""
    seen, eyes = np.zeros(len(points), bool), np.zeros_like(points)
    for elevation in np.deg2rad([8, 25, 45]):
        for azimuth in np.arange(8) * np.pi / 4 + elevation:
            across = np.cos(elevation)
            out = [across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)]
            hidden = np.flatnonzero(~seen)
            origins = np.tile(scene.look_at + 2.4 * np.array(out), (len(hidden), 1))
            rays = (points[hidden] - origins).astype(np.float32)
            found = hidden[scene.cast(origins.astype(np.float32), rays).distance > 0.999]
            eyes[found] = origins[0] if len(origins) else 0
            seen[found] = True
    return eyes, seen
