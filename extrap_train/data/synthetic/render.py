"""What is seen of a synthetic scene: photographs with exact depth and mask, and its surface as
points. Textures are lit by sun and sky, with shadows and highlights.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from extrap_train.data.synthetic.kernels import dot, fractal_noise, normalize, rotate
from extrap_train.data.synthetic.material import LocalPoints, linear_to_srgb
from extrap_train.data.synthetic.parts import Hits, Part, SyntheticScene
from extrap_train.views import Camera, View

DENSE_POINTS = 100_000
"""So many surface points leave no gap of 2 % of the object's size, the tolerance of scores."""
_REACH = 1.5
"""Farthest points, in object heights from the origin."""
_LARGE = 0.3
"""Triangles of a greater radius are cut: a part of them may be within reach."""
_PIXEL_ANGLE = 0.004
"""Radians: textures are sampled as finely as a photograph shows them."""
_SHADOW_OFFSET = np.float32(0.004)


def render(scene: SyntheticScene, camera: Camera, supersample: int = 2) -> View:
    """A photograph of the scene; depth and mask are those of the ray through each pixel's centre.

    Colours are the mean linear light of `supersample`² rays a pixel, then encoded as sRGB.
    """
    height, width = camera.height, camera.width
    depth, mask = trace(scene, camera)
    light = radiance(scene, *_rays(camera, supersample), float(1 / camera.intrinsics[0, 0]))
    light = light.reshape(height, supersample, width, supersample, 3).clip(0, 1).mean((1, 3))
    image = linear_to_srgb(light).transpose(2, 0, 1).astype(np.float32)
    return View(torch.from_numpy(np.ascontiguousarray(image)), camera, depth, mask)


def trace(
    scene: SyntheticScene, camera: Camera
) -> tuple[Float[torch.Tensor, "h w"], Float[torch.Tensor, "h w"]]:
    """Depth and object mask of the rays through the pixels' centres, without any colour."""
    centre = scene.cast(*_rays(camera, 1))
    found = centre.face >= 0
    is_object = np.array([part.is_object for part in scene.parts])[scene.part_of_face]
    maps = np.where(found, centre.distance, 0), is_object[centre.face] & found
    size = (camera.height, camera.width)
    depth, mask = (torch.from_numpy(m.reshape(size).astype(np.float32)) for m in maps)
    return depth, mask


def _rays(
    camera: Camera, supersample: int
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Origins and directions, row by row; with z = 1 in the camera, distance is depth."""
    k = camera.intrinsics.double().numpy()
    cam_to_world = camera.cam_to_world.double().numpy()
    columns = (np.arange(camera.width * supersample) + 0.5) / supersample
    rows = (np.arange(camera.height * supersample) + 0.5) / supersample
    x, y = np.meshgrid((columns - k[0, 2]) / k[0, 0], (rows - k[1, 2]) / k[1, 1])
    directions = rotate(np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3), cam_to_world[:3, :3])
    origins = np.broadcast_to(cam_to_world[:3, 3], directions.shape)
    return np.ascontiguousarray(origins, np.float32), directions.astype(np.float32)


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
    """Points on what can be seen from outside within 1.5 of the origin: about half of them spread
    evenly over the object, the others over what surrounds it.

    A point is kept where one of the eyes around the scene sees it: inner walls and undersides that
    touch the ground are left out.
    """
    rng = np.random.default_rng(count)
    corners, on_object = _triangles_within_reach(scene)
    a, b, c = corners.swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b[:, :3] - a[:, :3], c[:, :3] - a[:, :3]), axis=1)
    for part in (on_object, ~on_object):
        area[part] /= 2 * area[part].sum()
    chosen = rng.choice(len(area), 3 * count, p=area)
    u, v = rng.random((2, 3 * count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    points, normals = np.split(a[chosen] * (1 - u - v) + b[chosen] * u + c[chosen] * v, 2, axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    eyes, seen = _eyes_that_see(scene, points)
    kept = np.flatnonzero(seen)[:count]
    points, normals, eyes = points[kept], normals[kept], eyes[kept].astype(np.float32)
    light = radiance(scene, eyes, (points - eyes).astype(np.float32), _PIXEL_ANGLE)
    return SurfacePoints(points, normals, linear_to_srgb(light.clip(0, 1)), on_object[chosen[kept]])


def _triangles_within_reach(
    scene: SyntheticScene,
) -> tuple[Float[np.ndarray, "n 3 6"], Bool[np.ndarray, " n"]]:
    """Position and normal of the triangles' corners, the large ones cut into small ones, and which
    triangles are of the object.
    """
    mesh = scene.mesh
    corners = np.concatenate([mesh.vertices, mesh.normals], 1)[mesh.faces]
    on_object = np.array([part.is_object for part in scene.parts])[scene.part_of_face]
    while True:
        middle = corners[..., :3].mean(1)
        radius = np.linalg.norm(corners[..., :3] - middle[:, None], axis=-1).max(1)
        is_large = radius > _LARGE
        near = np.linalg.norm(middle, axis=1) < _REACH + np.where(is_large, radius, 0)
        if not (near & is_large).any():
            return corners[near], on_object[near]
        a, b, c = corners[near & is_large].swapaxes(0, 1)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        cut = [
            np.stack(three, 1) for three in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        ]
        small = near & ~is_large
        corners = np.concatenate([corners[small], *cut])
        on_object = np.concatenate([on_object[small], np.tile(on_object[near & is_large], 4)])


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


def _local_surface(part: Part, lit: _Lit) -> LocalPoints:
    """The hit points in the part's own coordinates."""
    scale = np.cbrt(np.linalg.det(part.part_to_world[:3, :3]))
    rotation = (part.part_to_world[:3, :3] / scale).astype(np.float32)
    shift = part.part_to_world[:3, 3].astype(np.float32)
    return LocalPoints(
        rotate(lit.points - shift, rotation.T) / np.float32(scale),
        rotate(lit.normals, rotation.T),
        lit.footprint / np.float32(scale),
    )


def _roughen(
    part: Part, surface: LocalPoints, normals: Float[np.ndarray, "n 3"]
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
