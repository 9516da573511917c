"""Light that reaches the eye: textures under sun and sky, with shadows and highlights."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from extrap_train.data.synthetic.material import Surface
from extrap_train.data.synthetic.noise import fractal_noise
from extrap_train.data.synthetic.parts import Hits, Part, SyntheticScene
from extrap_train.data.synthetic.vectors import dot, normalize, rotate

_SHADOW_OFFSET = np.float32(0.004)


def radiance(
    scene: SyntheticScene,
    origins: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
    pixel_angle: float,
) -> Float[np.ndarray, "n 3"]:
    """Linear light that arrives along each ray."""
    hits = scene.cast(origins, directions)
    light = np.zeros(directions.shape, np.float32)
    part_of_ray = np.where(hits.face >= 0, scene.part_of_face[hits.face], len(scene.parts))
    part_of_ray = part_of_ray.astype(np.int16)  # which sorts by counting
    order = np.argsort(part_of_ray, kind="stable")
    bounds = np.searchsorted(part_of_ray[order], np.arange(len(scene.parts) + 1))
    for part, start, end in zip(scene.parts, bounds, bounds[1:], strict=False):
        if start < end:
            rays = order[start:end]
            arriving = _arrive(
                scene, _select(hits, rays), origins[rays], directions[rays], pixel_angle
            )
            light[rays] = _shade(scene, part, arriving)
    return light


def _select(hits: Hits, rays: np.ndarray) -> Hits:
    return Hits(hits.face[rays], hits.distance[rays], hits.u[rays], hits.v[rays])


@dataclass(frozen=True)
class _Lit:
    """Hit points in the world with what shading needs."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    to_eye: Float[np.ndarray, "n 3"]
    ambient: Float[np.ndarray, "n 3"]
    footprint: Float[np.ndarray, " n"]


def _shade(scene: SyntheticScene, part: Part, lit: _Lit) -> Float[np.ndarray, "n 3"]:
    surface = _local_surface(part, lit)
    albedo = part.material.texture(surface)
    if part.material.glow == 1:
        return albedo
    normals = _roughen(part, surface, lit.normals)
    to_sun = scene.light.to_sun
    cosine = np.maximum(dot(normals, to_sun), 0)
    facing = np.flatnonzero((cosine > 0) & (dot(lit.normals, to_sun) > 0))
    sunlit = np.zeros(len(albedo), np.float32)
    start = lit.points[facing] + _SHADOW_OFFSET * lit.normals[facing]
    sunlit[facing] = 1 - scene.in_shadow(start, to_sun)
    tilt = dot(normals, lit.normals)[:, None]  # rough surfaces shade their own pits
    light = albedo * (lit.ambient * tilt + (sunlit * cosine)[:, None] * scene.light.sun)
    if part.material.gloss > 0:
        light += _highlight(scene, part, lit, normals, sunlit)
    return light


def _arrive(
    scene: SyntheticScene,
    hits: Hits,
    origins: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
    pixel_angle: float,
) -> _Lit:
    attributes = scene.interpolate(hits)
    to_eye = normalize(-directions)
    normals = normalize(attributes[:, :3])
    cosine = dot(normals, to_eye)
    normals *= np.copysign(np.float32(1), cosine)[:, None]  # thin sheets have two sides
    # Between the pixel's width across the view and its length along a grazing surface.
    spread = 1 / np.sqrt(np.maximum(np.abs(cosine), np.float32(0.05)))
    footprint = hits.distance * np.float32(pixel_angle) * spread
    points = origins + hits.distance[:, None] * directions
    return _Lit(points, normals, to_eye, attributes[:, 3:], footprint)


def _local_surface(part: Part, lit: _Lit) -> Surface:
    """The hit points in the part's own coordinates."""
    scale = np.cbrt(np.linalg.det(part.part_to_world[:3, :3]))
    rotation = (part.part_to_world[:3, :3] / scale).astype(np.float32)
    shift = part.part_to_world[:3, 3].astype(np.float32)
    return Surface(
        rotate(lit.points - shift, rotation.T) / np.float32(scale),
        rotate(lit.normals, rotation.T),
        lit.footprint / np.float32(scale),
    )


def _roughen(
    part: Part, surface: Surface, normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Normals tilted by fine noise: fur, cast iron, bark."""
    material = part.material
    if material.roughness == 0:
        return normals
    tilts = [
        fractal_noise(surface.points, surface.footprint, material.roughness_frequency, 2, 101 * i)
        for i in range(3)
    ]
    tilted = normals + material.roughness * np.stack(tilts, -1)
    return normalize(tilted)


def _highlight(
    scene: SyntheticScene,
    part: Part,
    lit: _Lit,
    normals: Float[np.ndarray, "n 3"],
    sunlit: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """Blinn-Phong highlight of the sun, and a faint mirror image of the sky at grazing angles."""
    half = normalize(lit.to_eye + scene.light.to_sun)
    glint = np.maximum(dot(half, normals), 0) ** np.float32(part.material.shininess) * sunlit
    grazing = 1 - np.clip(dot(lit.to_eye, normals), 0, 1)
    mirrored = np.float32(0.35) * grazing**4
    gloss = np.float32(part.material.gloss)
    return gloss * (1.5 * glint[:, None] * scene.light.sun + mirrored[:, None] * lit.ambient)
