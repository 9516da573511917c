"""What matched features say of a capture's poses, scale, lens and masks.

Each view is matched with its two nearest. Matches must lie on their epipolar lines (poses, lens).
Points triangulated from a view and one neighbour must be seen by the other where it has them (the
distances between cameras), and lie where depth files say (the unit of depth).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.data.camera_check import (
    ROLLED,
    TRANSPOSED,
    quaternions_rolled,
    rotations_transposed,
)
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import project, transform, unproject_to_world
from extrap_train.geometry.epipolar import (
    epipolar_distance,
    fundamental_matrix,
    triangulate,
    viewing_rays,
)
from extrap_train.geometry.viewpoints import references_by_nearness
from extrap_train.matching.sift import descriptor_distance, detect_sift, match_mutual
from extrap_train.views import Camera, View, stack_poses

Pixels = Float[np.ndarray, "_ 2"]
"""Pixels, one row per match."""
SIDE = 960
"""Photographs are matched at this many pixels a side, at most."""
POSE_SIDE = 640
"""The same, where the poses alone are checked."""
MIN_MATCHES = 30
FAR_PIXELS = 4.0
"""Median epipolar distance from which poses are suspect."""
CLEARLY_BETTER = 0.4
RATIO = 0.75
"""Largest ratio of the nearest and second nearest distance in Lowe's test."""
MIN_POINTS = 8
"""Least points in a third view: two views already agree on them, so fewer suffice."""
MIN_PARALLAX_RAD = np.deg2rad(1.5)
"""Least angle between two rays for the point where they meet to be used."""
MIDDLE, BORDER = 0.4, 0.7
"""Radii as shares of half the diagonal: a lens is checked within the first against beyond the
second."""
LENS_PIXELS, LENS_RATIO = 0.5, 3.0
"""A border is bent if its matches lie this far off, and this many times farther than the middle's:
most of a distortion runs along the epipolar lines of an orbit and does not show."""
DEPTH_RATIO = 1.25
MASK_DISAGREEMENT = 0.3
"""Share of the matched points in either view's mask that may be missing from the other's."""
MASK_SHARES = (0.002, 0.95)
"""Range of an object mask's share of the picture."""
_FLIPS = {
    "OpenGL axes (+Y up, -Z forward)": (1.0, -1.0, -1.0),
    "PyTorch3D axes (+X left, +Y up)": (-1.0, -1.0, 1.0),
}


@dataclass(frozen=True)
class MatchedViews:
    """A view and its two nearest, with pixels of the same features."""

    views: tuple[int, int, int]
    """Indices: the view itself, then the nearest."""
    pixels: Float[np.ndarray, "n 2"]
    matches: Float[np.ndarray, "n 2"]
    """In the nearest view."""
    distances: Float[np.ndarray, " n"]
    """Distance of each match from the epipolar line of its pixel, in pixels."""
    points: Float[Tensor, "n 3"]
    """Triangulated from both; NaN where the rays meet at too small an angle or not at all."""
    third: Float[np.ndarray, "m 2"]
    """Matches in the second nearest view of those with a point."""
    reprojected: Float[np.ndarray, "m 2"]
    """Where that view should have them."""

    @property
    def distance(self) -> float:
        """Median distance from the epipolar lines; NaN for too few matches."""
        return _median(self.distances)

    @property
    def reprojection(self) -> float:
        """Median distance in the third view; NaN for too few matches."""
        errors = np.linalg.norm(self.third - self.reprojected, axis=1)
        return _median(errors, MIN_POINTS)


@dataclass(frozen=True)
class CaptureCheck:
    """What was found of a capture."""

    views: list[View]
    """At the size at which they were matched."""
    matched: list[MatchedViews]
    """One for each view, in order."""
    problems: list[str] = field(default_factory=list)
    """One line each."""

    @property
    def residuals(self) -> tuple[float, float]:
        """Median distances in pixels, over all views, of matches from their epipolar lines and of
        points of two views from where a third has them; NaN for too few."""
        third = [np.linalg.norm(m.third - m.reprojected, axis=1) for m in self.matched]
        distances = np.concatenate([m.distances for m in self.matched])
        return _median(distances), _median(np.concatenate(third), MIN_POINTS)


def check_capture(views: Sequence[View]) -> CaptureCheck:
    """Match three views or more; every problem names its views and likely cause."""
    small = [_small_view(view, SIDE) for view in views]
    cameras = stack_poses([view.camera for view in small])
    nearest = references_by_nearness(cameras, cameras)
    features = [detect_sift(view.image) for view in small]

    @cache
    def matches(first: int, second: int) -> Int[np.ndarray, "n 2"]:
        if first > second:
            return matches(second, first)[:, ::-1]
        return match_mutual(descriptor_distance(features[first], features[second]), RATIO)

    def matched_pixels(first: int, second: int) -> tuple[Pixels, Pixels]:
        pairs = matches(first, second)
        return features[first].pixels[pairs[:, 0]], features[second].pixels[pairs[:, 1]]

    matched = []
    for index, order in enumerate(nearest.tolist()):
        one, two = [other for other in order if other != index][:2]
        pairs, others = matches(index, one), matches(index, two)
        pixels, nearest_pixels = matched_pixels(index, one)
        third = features[two].pixels
        matched.append(
            _measure(small, (index, one, two), pixels, nearest_pixels, pairs, others, third)
        )
    check = CaptureCheck(small, matched)
    try:
        check_matches(
            (small[i].camera, small[i + 1].camera, *matched_pixels(i, i + 1))
            for i in range(len(small) - 1)
        )
    except InputError as error:
        check.problems.append(str(error))
    check.problems.extend(_problems(check))
    return check


def _measure(
    views: Sequence[View],
    indices: tuple[int, int, int],
    pixels: Float[np.ndarray, "n 2"],
    matches: Float[np.ndarray, "n 2"],
    pairs: Int[np.ndarray, "n 2"],
    others: Int[np.ndarray, "m 2"],
    third_pixels: Float[np.ndarray, "k 2"],
) -> MatchedViews:
    camera, nearest, third = (views[index].camera for index in indices)
    distances = epipolar_distance(pixels, matches, fundamental_matrix(camera, nearest))
    starts, ends = torch.from_numpy(pixels).float(), torch.from_numpy(matches).float()
    found = triangulate(starts, ends, camera, nearest)
    usable = (found.depth > 0) & (found.parallax_rad > MIN_PARALLAX_RAD)
    depth = torch.where(usable, found.depth, torch.nan)[:, None]
    points = transform(camera.cam_to_world, depth * viewing_rays(starts, camera))
    _, in_pairs, in_others = np.intersect1d(
        pairs[:, 0], others[:, 0], assume_unique=True, return_indices=True
    )
    kept = usable.numpy()[in_pairs] & (distances[in_pairs] < FAR_PIXELS)
    reprojected, _ = project(points[in_pairs[kept]], third)
    seen = third_pixels[others[in_others[kept], 1]]
    return MatchedViews(indices, pixels, matches, distances, points, seen, reprojected.numpy())


def _median(values: Float[np.ndarray, " n"], least: int = MIN_MATCHES) -> float:
    return float(np.median(values)) if len(values) >= least else float("nan")


def _problems(check: CaptureCheck) -> Iterator[str]:
    names = [view.name for view in check.views]
    lone = [names[m.views[0]] for m in check.matched if len(m.distances) < MIN_MATCHES]
    if lone:
        yield f"overlap: {_listed(lone)} share too few features with the nearest view to say more"
    off = [m for m in check.matched if m.distance > FAR_PIXELS]
    if off:
        worst = max(off, key=lambda m: m.distance)
        yield (
            f"poses: in {_listed([names[m.views[0]] for m in off])} matches lie up to "
            f"{worst.distance:.1f} px from their epipolar lines: a pose or focal length is wrong"
        )
    stretched = [m for m in check.matched if m.distance <= FAR_PIXELS < m.reprojection / 2]
    if stretched:
        yield (
            f"scale: points seen from {_listed([names[m.views[0]] for m in stretched])} are up to "
            f"{max(m.reprojection for m in stretched):.1f} px from where a third view has them: "
            "the distances between cameras do not agree"
        )
    yield from _lens_problem(check)
    yield from _depth_problem(check)
    yield from _mask_problems(check)


def _lens_problem(check: CaptureCheck) -> Iterator[str]:
    radius, distance = [], []
    for each in check.matched:
        camera = check.views[each.views[0]].camera
        middle = np.array([camera.width, camera.height]) / 2
        radius.append(np.linalg.norm((each.pixels - middle) / np.linalg.norm(middle), axis=1))
        distance.append(each.distances)
    radii, distances = np.concatenate(radius), np.concatenate(distance)
    inner, outer = _median(distances[radii < MIDDLE]), _median(distances[radii > BORDER])
    if outer > max(LENS_PIXELS, LENS_RATIO * inner):
        yield (
            f"lens: matches near the border lie {outer:.1f} px from their epipolar lines, in the "
            f"middle {inner:.1f} px: its distortion is wrong or missing"
        )


def _depth_problem(check: CaptureCheck) -> Iterator[str]:
    ratios = []
    for each in check.matched:
        view = check.views[each.views[0]]
        if view.depth is None:
            continue
        column, row = each.pixels.astype(int).T
        stored = view.depth[row, column]
        points = unproject_to_world(view.depth, view.camera)[row, column]
        center = view.camera.center
        ratio = (points - center).norm(dim=1) / (each.points - center).norm(dim=1)
        kept = (stored > 0) & torch.from_numpy(each.distances < FAR_PIXELS)
        ratios.append(ratio[kept & ratio.isfinite()].numpy())
    ratio = _median(np.concatenate(ratios)) if ratios else float("nan")
    if abs(np.log(ratio)) > np.log(DEPTH_RATIO):
        yield (
            f"scale: depth files say {ratio:.3g} times the depth that the cameras do: correct the "
            "unit of depth or the scale of the poses"
        )


def _mask_problems(check: CaptureCheck) -> Iterator[str]:
    least, most = MASK_SHARES
    for view in check.views:
        if view.mask is not None and not least <= float(view.mask.mean()) <= most:
            yield f"masks: that of {view.name} covers {view.mask.mean():.1%} of the picture"
    for each in check.matched:
        one, other = (check.views[k] for k in each.views[:2])
        if one.mask is None or other.mask is None:
            continue
        near = each.distances < FAR_PIXELS / 2
        first, second = (
            _inside(one.mask, each.pixels[near]),
            _inside(other.mask, each.matches[near]),
        )
        either = int((first | second).sum())
        differ = int((first ^ second).sum())
        if either >= MIN_MATCHES and differ > MASK_DISAGREEMENT * either:
            yield (
                f"masks: those of {one.name} and {other.name} cut out different things "
                f"({differ} of {either} matched points)"
            )


def _inside(mask: Float[Tensor, "h w"], pixels: Float[np.ndarray, "n 2"]) -> np.ndarray:
    column, row = pixels.astype(int).T
    return mask.numpy()[row, column] > 0.5


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def check_poses(views: Sequence[View]) -> None:
    """Raise InputError where matches contradict the poses and another convention explains them.

    Too few matches say nothing, and poses that no convention mends are left to the depth source.
    """
    small = [_small_view(view, POSE_SIDE) for view in views]
    described = [(view.camera, detect_sift(view.image)) for view in small]
    matched = []
    for (one, features), (other, others) in pairwise(described):
        pairs = match_mutual(descriptor_distance(features, others), RATIO)
        matched.append((one, other, features.pixels[pairs[:, 0]], others.pixels[pairs[:, 1]]))
    check_matches(matched)


def check_matches(matched: Iterable[tuple[Camera, Camera, Pixels, Pixels]]) -> None:
    """`check_poses` of pairs of views whose pixels are matched."""
    given: list[float] = []
    others: dict[str, list[float]] = {}
    for one, other, first, second in matched:
        if len(first) < MIN_MATCHES:
            continue
        given.append(_distance(first, second, one, other))
        others_of = _read_otherwise(other)
        for name, camera in _read_otherwise(one).items():
            others.setdefault(name, []).append(_distance(first, second, camera, others_of[name]))
    if not given or np.median(given) < FAR_PIXELS:
        return
    best = min(others, key=lambda name: float(np.median(others[name])))
    if np.median(others[best]) < CLEARLY_BETTER * np.median(given):
        raise InputError(
            f"the poses contradict the photographs: matches lie {np.median(given):.1f} px from "
            f"where they should, but {np.median(others[best]):.1f} px if the poses are read as "
            f"{best}; convert them first"
        )


def _small_view(view: View, side: int) -> View:
    """The view with at most this many pixels a side."""
    scale = side / max(view.camera.height, view.camera.width)
    if scale >= 1:
        return view
    return view.resized(round(view.camera.height * scale), round(view.camera.width * scale))


def _read_otherwise(camera: Camera) -> dict[str, Camera]:
    """The camera, had its matrix been meant otherwise."""
    flipped = {
        name: torch.diag(torch.tensor([*signs, 1.0])) @ camera.world_to_cam
        for name, signs in _FLIPS.items()
    }
    matrices = flipped | {
        "camera-to-world matrices": camera.cam_to_world,
        # Around the world's origin, cameras read in these two ways still look at it.
        ROLLED: quaternions_rolled(camera.world_to_cam),
        TRANSPOSED: rotations_transposed(camera.world_to_cam),
    }
    return {name: replace(camera, world_to_cam=found) for name, found in matrices.items()}


def _distance(first: Pixels, second: Pixels, one: Camera, other: Camera) -> float:
    """Median distance of the second points from the first ones' epipolar lines, in pixels."""
    return float(np.median(epipolar_distance(first, second, fundamental_matrix(one, other))))
