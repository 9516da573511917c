"""The object's planes of symmetry, and the photographs mirrored in them.

Most objects have one: what the photographs show of one side says what the other side looks like.
A plane is believed if it maps what they show onto what they show, and neither into space that they
have seen to be empty nor out of the object's outline. (Thrun and Wegbreit, Shape from symmetry,
2005, weigh the same evidence.)
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.geometry.mirror import MirrorPlane, mirrored_view
from extrap_train.geometry.viewpoints import fit_orbit_of_few
from extrap_train.reconstruction.global_map import GlobalMap, MapView, Origin, Sight, look_up

MIRRORED = "mirrored"
"""Kind of a mirrored photograph; none is ever part of a map."""
_MIRRORED_CONFIDENCE = 0.5
"""Factor on a photograph's confidence: what it shows is only likely to be on the other side."""
_MIN_AGREEMENT = 0.25
"""Share of the object's mirrored points that must lie on surfaces that the photographs show."""
_MAX_CONTRADICTION = 0.03
"""Share of them that may lie where a photograph shows empty space, or no object."""
_MIN_GAIN = 0.1
"""Share of them that must lie where no photograph looks: else there is nothing to add."""
_RELIABLE = 0.3
"""Confidence of the depths that symmetry is sought in."""
_TOLERANCE = 0.015
"""Relative difference of depth up to which a mirrored point lies on a surface."""
_TILTS_RAD = np.radians([-20.0, -10.0, 0.0, 10.0, 20.0])
"""Of a plane against the orbit's axis: objects stand upright, about."""
_AZIMUTHS_RAD = np.radians(np.arange(0.0, 180.0, 6.0))
_SHIFTS = np.arange(-0.45, 0.46, 0.03)
"""Of a plane from the middle of what is seen, in the object's sizes."""
_COARSE_POINTS, _FINE_POINTS = 200, 800
_REFINED = 40
"""Planes, of different normals, that are refined, each by itself."""
_FINE_TOLERANCES = (0.015, 0.01, 0.0075, 0.0075, 0.0075)
"""Tolerance of each round of refinement; its steps are half as long as the last one's."""
_MAX_COSINE = 0.6
"""Of the angle between the normals of two planes."""
_NEIGHBOURS = 27
"""Planes of `_planes_near` for each one, itself among them."""
_BATCH = 400
"""Planes that are weighed at a time."""


@dataclass(frozen=True)
class Symmetry:
    """A plane, or a batch of them, with the evidence: shares of the object's mirrored points."""

    plane: MirrorPlane
    agreement: Float[Tensor, "*b"]
    """On a surface that a photograph shows."""
    contradiction: Float[Tensor, "*b"]
    """In space that a photograph shows to be empty, or where it shows no object; less the share of
    them that is there without any mirror, since inexact depths contradict each other.
    """

    @property
    def gain(self) -> Float[Tensor, "*b"]:
        """Where no photograph looks: what the plane adds."""
        return 1 - self.agreement - self.contradiction

    @property
    def is_believed(self) -> Bool[Tensor, "*b"]:
        """Whether the evidence suffices, and something is added."""
        is_known = (self.agreement >= _MIN_AGREEMENT) & (self.contradiction <= _MAX_CONTRADICTION)
        return is_known & (self.gain >= _MIN_GAIN)

    @property
    def merit(self) -> Float[Tensor, "*b"]:
        """What a plane is chosen by, of different ones: one that maps everything onto itself adds
        nothing, and nothing speaks for one that maps nothing onto what is seen.
        """
        return self.agreement * self.gain - self.contradiction

    def __getitem__(self, chosen: Tensor) -> "Symmetry":
        plane = MirrorPlane(self.plane.normal[chosen], self.plane.offset[chosen])
        return Symmetry(plane, self.agreement[chosen], self.contradiction[chosen])


def find_symmetries(inputs: GlobalMap) -> tuple[Symmetry, ...]:
    """The object's planes of symmetry that add most to what the photographs show, at most two, the
    best first; none if none is believed, as where no view has a mask of the object.

    Planes stand within about 25° of the axis that the cameras circle, and the two about 50° or more
    apart. The same input gives the same planes.
    """
    points = _object_points(inputs)
    if len(points) < _COARSE_POINTS:
        return ()
    low, high = points.amin(0), points.amax(0)
    middle, size = (low + high) / 2, float((high - low).max())
    points = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))]
    coarse = _planes_around(middle, size, inputs)
    found = _weigh(coarse, points[:_COARSE_POINTS], inputs, _TOLERANCE)
    found = found[_best_of_each(found.merit.view(-1, len(_SHIFTS)))]  # one shift of each normal
    best: list[Symmetry] = []
    while len(best) < 2 and (chosen := _refined(found, points[:_FINE_POINTS], inputs)) is not None:
        best.append(chosen)
        cosines = found.plane.normal @ chosen.plane.normal
        found = found[(cosines.abs() < _MAX_COSINE).nonzero()[:, 0]]
    return tuple(best)


def _refined(coarse: Symmetry, points: Float[Tensor, "n 3"], inputs: GlobalMap) -> Symmetry | None:
    """The best of these planes, each moved to where it is best; None if none is believed."""
    found = coarse[coarse.merit.argsort(descending=True, stable=True)[:_REFINED]]
    middle = (points.amin(0) + points.amax(0)) / 2
    size = float((points.amax(0) - points.amin(0)).max())
    step_rad = float(_AZIMUTHS_RAD[1] - _AZIMUTHS_RAD[0]) / 2
    for tolerance in _FINE_TOLERANCES:
        near = _planes_near(found.plane, middle, step_rad, step_rad * size / 2)
        found = _weigh(near, points, inputs, tolerance)
        found = found[_best_of_each(found.merit.view(-1, _NEIGHBOURS))]
        step_rad /= 2
    believed = found[found.is_believed.nonzero()[:, 0]]
    return believed[believed.merit.argmax()] if len(believed.merit) else None


def mirrored_photographs(inputs: GlobalMap, symmetries: Sequence[Symmetry]) -> tuple[MapView, ...]:
    """The map's views that have a mask, as each mirror shows them, and as the second shows what the
    first does. Their depth is the object's alone, and only where no view shows or contradicts it:
    a photograph's own colours are surer.
    """
    objects = []
    for view in inputs.views:
        if view.view.mask is not None:
            depth = torch.where(_inner(view.view.mask), view.depth, 0)
            objects.append(replace(view, view=replace(view.view, depth=depth, mask=None)))
    given = len(objects)
    for symmetry in symmetries:
        objects += [_mirrored(view, symmetry.plane, inputs) for view in objects]
    return tuple(objects[given:])


def _mirrored(view: MapView, plane: MirrorPlane, inputs: GlobalMap) -> MapView:
    mirrored = mirrored_view(view.view, plane)
    assert mirrored.depth is not None
    points = unproject_to_world(mirrored.depth, mirrored.camera).flatten(0, 1)
    seen, empty = _sights(points, inputs, inputs.tolerance).view(2, *view.depth.shape)
    shown = (mirrored.depth > 0) & ~seen & ~empty
    return MapView(
        replace(mirrored, depth=torch.where(shown, mirrored.depth, 0)),
        torch.where(shown, _MIRRORED_CONFIDENCE * view.confidence.flip(-1), 0),
        torch.zeros_like(shown),
        Origin(MIRRORED, root=view.origin.root),
    )


def _object_points(inputs: GlobalMap) -> Float[Tensor, "n 3"]:
    points = [torch.empty(0, 3)]
    for view in inputs.views:
        if view.view.mask is not None:
            chosen = _inner(view.view.mask) & (view.depth > 0) & (view.confidence >= _RELIABLE)
            points.append(unproject_to_world(view.depth, view.camera)[chosen])
    return torch.cat(points)


def _inner(mask: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """The mask without its border, where depth may be that of what lies behind."""
    return -functional.max_pool2d(-mask[None, None], 3, 1, 1)[0, 0] > 0.5


def _outer(mask: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """The mask and a border around it, where the object may still be."""
    return functional.max_pool2d(mask[None, None], 3, 1, 1)[0, 0] > 0.5


def _planes_around(middle: Float[Tensor, "3"], size: float, inputs: GlobalMap) -> MirrorPlane:
    orbit = fit_orbit_of_few(inputs.cameras)
    north = np.cross(orbit.axis, orbit.east)
    azimuth, tilt, shift = np.meshgrid(_AZIMUTHS_RAD, _TILTS_RAD, _SHIFTS * size, indexing="ij")
    level = np.cos(azimuth)[..., None] * orbit.east + np.sin(azimuth)[..., None] * north
    normals = np.cos(tilt)[..., None] * level + np.sin(tilt)[..., None] * orbit.axis
    normal = torch.from_numpy(normals.reshape(-1, 3)).to(middle)
    return MirrorPlane(normal, normal @ middle + torch.from_numpy(shift.ravel()).to(middle))


def _planes_near(
    planes: MirrorPlane, middle: Float[Tensor, "3"], step_rad: float, step: float
) -> MirrorPlane:
    """Each plane with its 26 neighbours, turned about two axes and shifted by one step."""
    steps = torch.cartesian_prod(*[torch.tensor([0.0, -1.0, 1.0])] * 3).to(middle)
    first = torch.linalg.cross(planes.normal, _least_aligned(planes.normal))
    first = functional.normalize(first, dim=-1)
    second = torch.linalg.cross(planes.normal, first)
    turned = planes.normal[:, None] + step_rad * (
        steps[:, :1] * first[:, None] + steps[:, 1:2] * second[:, None]
    )
    normal = functional.normalize(turned, dim=-1)
    at_middle = planes.offset - planes.normal @ middle
    offset = normal @ middle + at_middle[:, None] + step * steps[:, 2]
    return MirrorPlane(normal.flatten(0, 1), offset.flatten())


def _least_aligned(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """The world's axis that each normal has least of."""
    return torch.eye(3).to(normals)[normals.abs().argmin(-1)]


def _best_of_each(merit: Float[Tensor, "n m"]) -> Int[Tensor, " n"]:
    """Of every row the flat index of its greatest merit."""
    return merit.argmax(1) + merit.shape[1] * torch.arange(len(merit))


def _weigh(
    planes: MirrorPlane, points: Float[Tensor, "n 3"], inputs: GlobalMap, tolerance: float
) -> Symmetry:
    shares = []
    for start in range(0, len(planes.offset), _BATCH):
        part = slice(start, start + _BATCH)
        mirrored = MirrorPlane(planes.normal[part], planes.offset[part]).reflect(points)
        seen = _sights(mirrored.flatten(0, 1), inputs, tolerance)
        shares.append(seen.view(2, -1, len(points)).float().mean(-1))
    agreement, contradiction = torch.cat(shares, 1)
    own = _sights(points, inputs, tolerance)[1].float().mean()
    return Symmetry(planes, agreement, (contradiction - own).clamp(min=0))


def _sights(
    points: Float[Tensor, "n 3"], inputs: GlobalMap, tolerance: float
) -> Bool[Tensor, "2 n"]:
    """First row: which points of the object lie on a surface that some view shows. Second row,
    which takes precedence: which ones some view contradicts, as it has seen through them, or as
    they lie outside the object's mask, whatever the depth there.
    """
    agrees, empty = torch.zeros(2, len(points), dtype=torch.bool)
    for view in inputs.views:
        found = look_up(points, view.depth, view.camera, tolerance)
        is_measured = view.confidence.flatten()[found.pixel] >= _RELIABLE
        agrees |= (found.sight == Sight.AGREES) & is_measured
        empty |= (found.sight == Sight.IN_FRONT) & is_measured
        if view.view.mask is not None:
            is_object = _outer(view.view.mask).flatten()[found.pixel]
            empty |= found.inside & ~is_object
    return torch.stack([agrees & ~empty, empty])
