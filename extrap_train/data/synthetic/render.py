"""Ray casting a synthetic scene: antialiased colour, exact depth, object mask, ground-truth points."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from extrap_train.data.synthetic.material import Surface, linear_to_srgb
from extrap_train.data.synthetic.noise import fractal_noise
from extrap_train.data.synthetic.scene import Hits, Part, SyntheticScene
from extrap_train.data.synthetic.shapes import rotated
from extrap_train.views import Camera, View

_SHADOW_OFFSET = 0.004


def render(scene: SyntheticScene, camera: Camera, supersample: int = 2) -> View:
    """A photograph of the scene; depth and mask are those of the ray through each pixel's centre.

    Colours are the mean linear light of `supersample`² rays a pixel, then encoded as sRGB.
    """
    height, width = camera.height, camera.width
    centre = scene.cast(*_rays(camera, 1))
    found = centre.face >= 0
    depth = np.where(found, centre.distance, 0)
    is_object = np.array([part.is_object for part in scene.parts])[scene.part_of_face]
    mask = is_object[centre.face] & found
    light = radiance(scene, *_rays(camera, supersample), float(1 / camera.intrinsics[0, 0]))
    light = light.reshape(height, supersample, width, supersample, 3).clip(0, 1).mean((1, 3))
    image = linear_to_srgb(light).transpose(2, 0, 1).astype(np.float32)
    return View(
        torch.from_numpy(np.ascontiguousarray(image)),
        camera,
        torch.from_numpy(depth.reshape(height, width).astype(np.float32)),
        torch.from_numpy(mask.reshape(height, width).astype(np.float32)),
    )


def _rays(
    camera: Camera, supersample: int
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Origins and directions, row by row; directions have z = 1 in the camera, so distance is depth."""
    k = camera.intrinsics.double().numpy()
    cam_to_world = camera.cam_to_world.double().numpy()
    columns = (np.arange(camera.width * supersample) + 0.5) / supersample
    rows = (np.arange(camera.height * supersample) + 0.5) / supersample
    x, y = np.meshgrid((columns - k[0, 2]) / k[0, 0], (rows - k[1, 2]) / k[1, 1])
    directions = rotated(np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3), cam_to_world[:3, :3])
    origins = np.broadcast_to(cam_to_world[:3, 3], directions.shape)
    return np.ascontiguousarray(origins, np.float32), directions.astype(np.float32)


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
    normals = _roughened(part, surface, lit.normals)
    to_sun = scene.light.to_sun.astype(np.float32)
    cosine = np.maximum((normals * to_sun).sum(1), 0)
    facing = np.flatnonzero((cosine > 0) & ((lit.normals * to_sun).sum(1) > 0))
    sunlit = np.zeros(len(albedo), np.float32)
    start = lit.points[facing] + _SHADOW_OFFSET * lit.normals[facing]
    sunlit[facing] = 1 - scene.in_shadow(start, to_sun)
    tilt = (normals * lit.normals).sum(1)[:, None]  # rough surfaces shade their own pits
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
    length = np.sqrt((directions * directions).sum(1))
    to_eye = directions / -length[:, None]
    normals = attributes[:, :3]
    cosine = (normals * to_eye).sum(1)
    normals = normals * np.where(cosine < 0, -1, 1)[:, None]  # thin sheets have two sides
    normals /= np.sqrt((normals * normals).sum(1))[:, None] + 1e-9
    # Between the pixel's width across the view and its length along a grazing surface.
    spread = 1 / np.sqrt(np.maximum(np.abs(cosine), 0.05))
    footprint = hits.distance * pixel_angle * spread
    points = origins + hits.distance[:, None] * directions
    return _Lit(points, normals, to_eye, attributes[:, 3:], footprint)


def _local_surface(part: Part, lit: _Lit) -> Surface:
    """The hit points in the part's own coordinates."""
    scale = np.cbrt(np.linalg.det(part.part_to_world[:3, :3]))
    rotation = (part.part_to_world[:3, :3] / scale).astype(np.float32)
    shift = part.part_to_world[:3, 3].astype(np.float32)
    return Surface(
        rotated(lit.points - shift, rotation.T) / np.float32(scale),
        rotated(lit.normals, rotation.T),
        lit.footprint / np.float32(scale),
    )


def _roughened(
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
    return tilted / np.sqrt((tilted * tilted).sum(1))[:, None]


def _highlight(
    scene: SyntheticScene,
    part: Part,
    lit: _Lit,
    normals: Float[np.ndarray, "n 3"],
    sunlit: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """Blinn-Phong highlight of the sun, and a faint mirror image of the sky at grazing angles."""
    half = lit.to_eye + scene.light.to_sun.astype(np.float32)
    half /= np.sqrt((half * half).sum(1))[:, None]
    glint = np.maximum((half * normals).sum(1), 0) ** part.material.shininess * sunlit
    grazing = 1 - np.clip((lit.to_eye * normals).sum(1), 0, 1)
    mirrored = 0.35 * grazing**4
    gloss = part.material.gloss
    return gloss * (glint[:, None] * scene.light.sun * 1.5 + mirrored[:, None] * lit.ambient)
