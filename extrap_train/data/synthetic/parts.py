"""A synthetic scene: placed parts, merged into one ray-castable geometry, and their light: one sun
(or lamp), a sky and what the ground throws back.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Int

from extrap_train.data.synthetic.kernels import Real
from extrap_train.data.synthetic.material import Material
from extrap_train.data.synthetic.shapes import Mesh, Point, merge, move_mesh
from extrap_train.geometry.compiled import compiled

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


@dataclass(frozen=True)
class Part:
    """A mesh of one material, in its own coordinates."""

    mesh: Mesh
    material: Material
    part_to_world: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """Rigid, or with an even scale."""
    is_object: bool = True
    """Whether it belongs to what the scene is a picture of."""
    casts_shadow: bool = True


def placement(
    position: Point = (0, 0, 0), turn_rad: Real = 0, tilt_rad: Real = 0, scale: Real = 1
) -> Float[np.ndarray, "4 4"]:
    """Scale, then tilt about +X, then turn about +Z, then shift."""
    ct, st, cz, sz = np.cos(tilt_rad), np.sin(tilt_rad), np.cos(turn_rad), np.sin(turn_rad)
    matrix = np.eye(4)
    tilt = np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    matrix[:3, :3] = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ tilt * scale
    matrix[:3, 3] = position
    return matrix


@dataclass(frozen=True)
class Hits:
    """Where rays meet surfaces; every array has one row per ray."""

    face: Int[np.ndarray, " n"]
    """-1 where a ray meets nothing."""
    distance: Float[np.ndarray, " n"]
    """In lengths of the ray's direction vector."""
    u: Float[np.ndarray, " n"]
    v: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class SyntheticScene:
    """An object on the ground at the world's origin, with surroundings. +Z is up."""

    category: str
    parts: tuple[Part, ...]
    light: Light
    look_at: Float[np.ndarray, " 3"]
    """Centre of the object."""
    radius: float
    """Radius of the smallest ball around `look_at` that holds the object."""

    @cached_property
    def mesh(self) -> Mesh:
        """All parts in world coordinates."""
        return merge([move_mesh(part.mesh, part.part_to_world) for part in self.parts])

    @cached_property
    def part_of_face(self) -> Int[np.ndarray, " f"]:
        """Index of the part that each face of `mesh` belongs to."""
        return np.repeat(np.arange(len(self.parts)), [len(p.mesh.faces) for p in self.parts])

    @cached_property
    def attributes(self) -> Float[np.ndarray, "v 6"]:
        """Normal and ambient light (linear RGB) of each vertex."""
        ambient = ambient_light(self.mesh, self.light, self._shadow_casters)
        return np.concatenate([self.mesh.normals, ambient], 1).astype(np.float32)

    @cached_property
    def _faces(self) -> Int[np.ndarray, "f 3"]:
        return np.ascontiguousarray(self.mesh.faces, dtype=np.int32)

    @cached_property
    def _everything(self) -> EmbreeScene:
        return _embree(self.mesh.vertices, self._faces)

    @cached_property
    def _shadow_casters(self) -> EmbreeScene:
        casting = np.array([part.casts_shadow for part in self.parts])[self.part_of_face]
        return _embree(self.mesh.vertices, self._faces[casting])

    def cast(self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]) -> Hits:
        """The first surface along each ray."""
        found = self._everything.run(origins, directions, query="INTERSECT", output=1)
        return Hits(found["primID"], found["tfar"], found["u"], found["v"])

    def in_shadow(
        self, points: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, " 3"]
    ) -> Float[np.ndarray, " n"]:
        """1 where something stands between the point and the far end of `direction`, else 0."""
        directions = np.ascontiguousarray(np.broadcast_to(direction, points.shape), np.float32)
        found = self._shadow_casters.run(
            np.ascontiguousarray(points, np.float32), directions, query="OCCLUDED"
        )
        return (found >= 0).astype(np.float32)

    def interpolate(self, hits: Hits) -> Float[np.ndarray, "n 6"]:
        """`attributes` at the hit points; every ray must have met something."""
        return _interpolate(self.attributes, self._faces, hits.face, hits.u, hits.v)


def _embree(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> EmbreeScene:
    scene = EmbreeScene()
    TriangleMesh(scene, vertices.astype(np.float32), np.ascontiguousarray(faces, np.int32))
    return scene


@compiled()
def _interpolate(attributes, faces, face, u, v):
    out = np.empty((len(face), attributes.shape[1]), np.float32)
    for n in range(len(face)):
        a, b, c = faces[face[n], 0], faces[face[n], 1], faces[face[n], 2]
        for k in range(attributes.shape[1]):
            out[n, k] = (
                attributes[a, k] * (1 - u[n] - v[n])
                + attributes[b, k] * u[n]
                + attributes[c, k] * v[n]
            )
    return out
