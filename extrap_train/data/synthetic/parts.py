"""A synthetic scene: placed parts and their light, merged into one ray-castable geometry."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Int

from extrap_train.data.synthetic.light import Light, ambient_light
from extrap_train.data.synthetic.material import Material
from extrap_train.data.synthetic.shapes import Mesh, Point, merge, move_mesh
from extrap_train.data.synthetic.vectors import Real
from extrap_train.geometry.compiled import compiled


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
