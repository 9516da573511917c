"""Triangle meshes with smooth normals from a handful of primitives; +Z is up."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from extrap_train.data.synthetic.kernels import Real, rotate

_CREASE = np.cos(np.deg2rad(35.0))


Point = tuple[Real, Real, Real] | Float[np.ndarray, " 3"]
Rows = np.ndarray | Sequence[Any]
"""An array, or what makes one."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh; where two faces meet at a crease, the vertices are doubled."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]


def xyz(x: Real, y: Real, z: Real) -> Float[np.ndarray, " 3"]:
    """A point or an offset."""
    return np.array([x, y, z], float)


def lathe(profile: Rows, segments: int = 32) -> Mesh:
    """The surface of revolution of (radius, height) points around +Z; sharp corners stay sharp."""
    rings = _split_corners(np.asarray(profile, float))
    angles = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], -1)
    points = np.concatenate(rings)
    vertices = np.concatenate(
        [
            points[:, None, :1] * circle,
            np.broadcast_to(points[:, None, 1:], (len(points), segments, 1)),
        ],
        -1,
    )
    starts = np.cumsum([0, *[len(ring) for ring in rings]])
    rows = np.concatenate([np.arange(a, b - 1) for a, b in pairwise(starts)])
    return _grid_mesh(vertices, rows, closed=True)


def _split_corners(profile: Float[np.ndarray, "k 2"]) -> list[np.ndarray]:
    """The polyline cut at its sharp corners."""
    steps = np.diff(profile, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    corners = np.flatnonzero((steps[1:] * steps[:-1]).sum(1) < _CREASE) + 1
    bounds = [0, *corners.tolist(), len(profile) - 1]
    return [profile[a : b + 1] for a, b in pairwise(bounds)]


def sweep(
    path: Rows, radii: Float[np.ndarray, " k"] | Real, segments: int = 10, flatten: float = 1.0
) -> Mesh:
    """A tube along a path, closed by small domes; `flatten` scales its sideways direction."""
    path = np.asarray(path, float)
    radii = np.broadcast_to(np.asarray(radii, float), len(path))
    tangents = np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    side = _sideways(tangents)
    up = np.cross(side, tangents)
    ends = np.array([0.0, 0.6, 0.9])  # share of the radius at the domes' rings
    path = np.concatenate(
        [
            path[:1] - tangents[:1] * radii[0] * np.sqrt(1 - ends**2)[:, None] * 0.6,
            path,
            path[-1:] + tangents[-1:] * radii[-1] * np.sqrt(1 - ends[::-1] ** 2)[:, None] * 0.6,
        ]
    )
    radii = np.concatenate([ends * radii[0], radii, ends[::-1] * radii[-1]])
    side, up = (
        np.concatenate([np.repeat(x[:1], 3, 0), x, np.repeat(x[-1:], 3, 0)]) for x in (side, up)
    )
    angles = np.linspace(0, 2 * np.pi, segments, endpoint=False)[:, None]
    ring = side[:, None] * np.cos(angles) * flatten - up[:, None] * np.sin(angles)
    vertices = path[:, None] + radii[:, None, None] * ring
    return _grid_mesh(vertices, np.arange(len(path) - 1), closed=True)


def _sideways(tangents: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    """A direction across the path that twists as little as possible."""
    least = np.argmin(np.abs(tangents).max(0))
    side = np.zeros_like(tangents)
    previous = np.eye(3)[least]
    for i, tangent in enumerate(tangents):
        previous = previous - tangent * (previous @ tangent)
        previous = previous / np.linalg.norm(previous)
        side[i] = previous
    return side


def rounded_box(size: Point, radius: Real = 0, steps: int = 2) -> Mesh:
    """A box centred at the origin whose edges are rounded by `radius`."""
    half = np.asarray(size, float) / 2
    radius = min(radius, float(half.min()) * 0.999)
    line = np.concatenate([np.linspace(-1, 0, steps + 1), np.linspace(0, 1, steps + 1)])
    sign = np.repeat([-1.0, 1.0], steps + 1)
    u, v = (x.ravel() for x in np.meshgrid(line, line, indexing="ij"))
    su, sv = (x.ravel() for x in np.meshgrid(sign, sign, indexing="ij"))
    patches = []
    for axis in range(3):
        for end in (-1.0, 1.0):
            order = [axis, (axis + 1) % 3, (axis + 2) % 3]
            direction, signs = np.empty((len(u), 3)), np.empty((len(u), 3))
            direction[:, order] = np.stack([np.full_like(u, end), u, v], -1)
            signs[:, order] = np.stack([np.full_like(u, end), su, sv], -1)
            if radius <= 0:
                direction = np.eye(3)[axis] * end * np.ones_like(direction)
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            vertices = signs * (half - radius) + radius * direction
            faces = _grid_faces(len(line), len(line), np.arange(len(line) - 1), closed=False)
            patches.append(_without_slivers(Mesh(vertices, faces, direction)))
    return merge(patches)


def ellipsoid(radii: Point, segments: int = 24, power: Real = 1) -> Mesh:
    """An ellipsoid centred at the origin; `power` below 1 makes it boxier (a superquadric)."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    profile = np.stack([np.cos(latitude), np.sin(latitude)], -1)
    sphere = lathe(np.clip(profile, [0, -1], [1, 1]), segments).vertices
    bent = np.sign(sphere) * np.abs(sphere) ** power
    rows = np.arange(len(latitude) - 1)
    return _grid_mesh((bent * radii).reshape(len(latitude), segments, 3), rows, closed=True)


def capsule(
    start: Float[np.ndarray, " 3"],
    end: Float[np.ndarray, " 3"],
    radius: Real,
    end_radius: Real | None = None,
    segments: int = 16,
) -> Mesh:
    """A limb between two points with round ends, tapering to `end_radius`."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    last = radius if end_radius is None else end_radius
    axis = (end - start) / np.linalg.norm(end - start)
    angles = np.linspace(0, np.pi / 2, 6)
    along = np.concatenate(
        [-radius * np.cos(angles), np.linalg.norm(end - start) + last * np.sin(angles)]
    )
    across = np.concatenate([radius * np.sin(angles), last * np.cos(angles)])
    side = _sideways(axis[None])[0]
    ring_angles = np.linspace(0, 2 * np.pi, segments, endpoint=False)[:, None]
    ring = side * np.cos(ring_angles) + np.cross(axis, side) * np.sin(ring_angles)
    vertices = start + along[:, None, None] * axis + np.abs(across)[:, None, None] * ring
    return _grid_mesh(vertices, np.arange(len(along) - 1), closed=True)


def sheet(points: Rows) -> Mesh:
    """An open surface through a grid of points, seen from both sides."""
    return _grid_mesh(np.asarray(points, float), np.arange(len(points) - 1), closed=False)


def flat_ground(half: tuple[Real, Real]) -> Mesh:
    """A rectangle in the plane z = 0, finely divided near its centre to carry soft shading."""
    spread = np.sinh(np.linspace(-3.2, 3.2, 44)) / np.sinh(3.2)
    x, y = np.meshgrid(spread * half[0], spread * half[1], indexing="xy")
    return sheet(np.stack([x, y, np.zeros_like(x)], -1))


def merge(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one."""
    offsets = np.cumsum([0, *[len(mesh.vertices) for mesh in meshes[:-1]]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([m.faces + o for m, o in zip(meshes, offsets, strict=True)]),
        np.concatenate([mesh.normals for mesh in meshes]),
    )


def move_mesh(mesh: Mesh, matrix: Float[np.ndarray, "4 4"]) -> Mesh:
    """The mesh under a rigid transform with an even scale."""
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    return Mesh(
        rotate(mesh.vertices, matrix[:3, :3]) + matrix[:3, 3],
        mesh.faces,
        rotate(mesh.normals, matrix[:3, :3] / scale),
    )


def displace(mesh: Mesh, offset: Float[np.ndarray, "v 3"]) -> Mesh:
    """The mesh with its vertices shifted, and its normals made anew."""
    vertices = mesh.vertices + offset
    return Mesh(vertices, mesh.faces, _vertex_normals(vertices, mesh.faces))


def _grid_mesh(
    vertices: Float[np.ndarray, "r c 3"], rows: Int[np.ndarray, " n"], closed: bool
) -> Mesh:
    faces = _grid_faces(vertices.shape[0], vertices.shape[1], rows, closed)
    flat = vertices.reshape(-1, 3)
    mesh = _without_slivers(Mesh(flat, faces, np.zeros_like(flat)))
    return Mesh(flat, mesh.faces, _vertex_normals(flat, mesh.faces))


def _grid_faces(
    rows: int, columns: int, used: Int[np.ndarray, " n"], closed: bool
) -> Int[np.ndarray, "f 3"]:
    column = np.arange(columns if closed else columns - 1)
    a = (used[:, None] * columns + column).ravel()
    b = (used[:, None] * columns + (column + 1) % columns).ravel()
    return np.concatenate(
        [np.stack([a, b, b + columns], -1), np.stack([a, b + columns, a + columns], -1)]
    )


def _without_slivers(mesh: Mesh) -> Mesh:
    """Leaves out faces without an area, as at the poles of a lathe."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return Mesh(mesh.vertices, mesh.faces[area > 1e-10], mesh.normals)


def _vertex_normals(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "v 3"]:
    """Area-weighted; vertices at the same place on a pole share none, which no one sees."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for i in range(3):
        for axis in range(3):
            normals[:, axis] += np.bincount(
                faces[:, i], face_normals[:, axis], minlength=len(vertices)
            )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 0, normals / np.maximum(length, 1e-30), [0.0, 0.0, 1.0])
