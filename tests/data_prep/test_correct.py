"""Warp correction against scenes whose depth is known exactly, with errors put in."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scenes import BOX_AND_PLANE, SPHERE_ON_PLANE, Scene, orbit_camera
from torch.nn import functional

from data_prep.correct import correct_pair, errors_in_common, photometric_error
from extrap_train.config import FlowMatcherConfig
from extrap_train.geometry.cameras import project, unproject_to_world
from extrap_train.geometry.warp import warp_references
from extrap_train.matching import Matches
from extrap_train.matching.dense_flow import FlowMatcher
from extrap_train.views import Camera, View, Warp, stack_cameras

SIZE, GRID = 128, 12
FLOW = FlowMatcher(FlowMatcherConfig())


def speckled(scene: Scene, camera: Camera) -> torch.Tensor:
    """The scene with a texture as fine as photographs have, fixed to its surfaces."""
    world = surface_points(scene, camera)
    waves = torch.randn(3, 40, generator=torch.Generator().manual_seed(5)) * 9
    fine = torch.sin(world @ waves + torch.arange(40.0)).view(*world.shape[:-1], 4, 10).mean(-1)
    return (scene.image(camera) + 0.8 * fine[..., :3].permute(2, 0, 1)).clamp(0, 1)


def surface_points(scene: Scene, camera: Camera) -> torch.Tensor:
    return unproject_to_world(scene.depth(camera)[None], stack_cameras([camera]))[0]


def smooth_error(seed: int, amount: float = 0.05, noise: float = 0.001) -> torch.Tensor:
    """Factors on depth: of low frequency, up to ±`amount`, plus noise."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.randn(1, 1, 4, 4, generator=generator)
    field = functional.interpolate(coarse, (SIZE, SIZE), mode="bicubic", align_corners=True)[0, 0]
    field = field / field.abs().max() * amount
    return 1 + field + noise * torch.randn(SIZE, SIZE, generator=generator)


def drawn(image, depth, reference, query, flow=None) -> Warp:
    return warp_references(
        image[None, None],
        depth[None, None],
        stack_cameras([stack_cameras([reference])]),
        torch.ones(1, 1, dtype=torch.bool),
        stack_cameras([query]),
        None if flow is None else flow[None, None],
    )


def misalignment(warp: Warp, scene: Scene, reference: Camera, query: Camera) -> float:
    """Median distance, in pixels, of the warp's pixels from where their surface point really is:
    rays through their own coordinates in the reference, intersected with the scene."""
    v, u = (warp.nearest_mask[0] > 0).nonzero().T
    pixel = (warp.coordinates[0, :, v, u].mT.double() + 1) / 2 * SIZE
    ones = torch.ones(len(pixel), 1, dtype=torch.float64)
    ray = torch.cat([pixel, ones], 1) @ torch.linalg.inv(reference.intrinsics.double()).T
    direction = ray @ reference.cam_to_world[:3, :3].double().T
    origin = reference.center.double().expand_as(direction)
    point = origin + direction * scene.hit(origin, direction)[:, None]
    there = project(point.float(), query)[0]
    apart = (there - torch.stack([u, v], -1) - 0.5).norm(dim=1)
    return float(apart[apart.isfinite()].median())


@pytest.mark.parametrize("scene", [SPHERE_ON_PLANE, BOX_AND_PLANE], ids=["sphere", "box"])
def test_misalignment_falls_and_never_rises(scene: Scene) -> None:
    before, after = [], []
    for seed, (first, second) in enumerate([(0, 12), (20, 5), (0, 25), (40, 60)]):
        reference, query = (orbit_camera(azimuth, size=SIZE) for azimuth in (first, second))
        image, truth = speckled(scene, reference), speckled(scene, query)
        depth = scene.depth(reference) * smooth_error(seed)
        found = correct_pair(View(image, reference, depth), View(truth, query), FLOW, GRID)
        for values, flow in ((before, None), (after, found.flow)):
            warp = drawn(image, depth, reference, query, flow)
            values.append(misalignment(warp, scene, reference, query))
    print(f"misalignment, px: {np.round(before, 2)} -> {np.round(after, 2)}")
    assert all(b >= a for b, a in zip(before, after, strict=True))
    assert np.median(after) <= 0.4 * np.median(before)


@pytest.mark.parametrize("scene", [SPHERE_ON_PLANE, BOX_AND_PLANE], ids=["sphere", "box"])
@pytest.mark.parametrize(("amount", "noise"), [(0, 0), (0.0025, 0.001), (0.05, 0.01)])
def test_no_pair_gets_worse_however_small_or_noisy_the_error(
    scene: Scene, amount: float, noise: float
) -> None:
    moved = 0
    for seed, (first, second) in enumerate([(0, 12), (40, 60), (300, 255), (10, 70)]):
        reference, query = (orbit_camera(azimuth, size=SIZE) for azimuth in (first, second))
        image, truth = speckled(scene, reference), speckled(scene, query)
        factors = smooth_error(seed, amount, noise) if noise else torch.ones(SIZE, SIZE)
        depth = scene.depth(reference) * factors
        found = correct_pair(View(image, reference, depth), View(truth, query), FLOW, GRID)
        if found.flow is None:
            continue
        moved += 1
        assert found.error_after < found.error_before
        before, after = (
            misalignment(drawn(image, depth, reference, query, flow), scene, reference, query)
            for flow in (None, found.flow)
        )
        assert after <= before
    assert moved == 4 or amount < 0.05


def test_exact_depth_is_left_alone_or_hardly_moved() -> None:
    reference, query = orbit_camera(0, size=SIZE), orbit_camera(20, size=SIZE)
    image, truth = (speckled(SPHERE_ON_PLANE, camera) for camera in (reference, query))
    depth = SPHERE_ON_PLANE.depth(reference)
    found = correct_pair(View(image, reference, depth), View(truth, query), FLOW, GRID)
    warps = [drawn(image, depth, reference, query, flow) for flow in (None, found.flow)]
    before, after = (misalignment(warp, SPHERE_ON_PLANE, reference, query) for warp in warps)
    assert after < max(before, 0.1)


class Fixed:
    """A matcher that answers the same whatever it is shown."""

    def __init__(self, first: torch.Tensor, step: torch.Tensor) -> None:
        self.matches = Matches(first, first + step, torch.ones(len(first)))

    def match(self, first, second, first_known=None) -> Matches:
        return self.matches


@pytest.mark.parametrize(
    ("count", "step", "reason"),
    [
        (0, torch.zeros(0, 2), "only 0 matches"),
        (39, torch.zeros(39, 2), "only 39 matches"),
        (300, torch.zeros(300, 2), "no motion in common"),
        (300, torch.tensor([6.0, 0.0]).repeat(300, 1), "comes no closer"),
        (300, torch.tensor([0.0, 6.0]).repeat(300, 1), "off their epipolar lines"),
        (300, 40 * torch.randn(300, 2, generator=torch.Generator().manual_seed(0)), "off their"),
    ],
    ids=["none", "few", "still", "wrong but unanimous", "across", "chance"],
)
def test_useless_matches_leave_the_warp_alone(count: int, step, reason: str) -> None:
    reference, query = orbit_camera(0, size=SIZE), orbit_camera(15, size=SIZE)
    image, truth = (speckled(SPHERE_ON_PLANE, camera) for camera in (reference, query))
    first = torch.rand(count, 2, generator=torch.Generator().manual_seed(1)) * SIZE
    depth = SPHERE_ON_PLANE.depth(reference)
    found = correct_pair(
        View(image, reference, depth), View(truth, query), Fixed(first, step), GRID
    )
    assert found.flow is None
    assert reason in found.reason
    assert found.error_after == found.error_before


def upside_down(truth: torch.Tensor) -> torch.Tensor:
    return truth.flip(1)


def smooth_noise(truth: torch.Tensor) -> torch.Tensor:
    coarse = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    return functional.interpolate(coarse, truth.shape[1:], mode="bicubic").clamp(0, 1)[0]


@pytest.mark.parametrize("wrong", [upside_down, smooth_noise])
@pytest.mark.parametrize("scene", [SPHERE_ON_PLANE, BOX_AND_PLANE], ids=["sphere", "box"])
def test_a_wrong_truth_corrects_nothing(
    scene: Scene, wrong: Callable[[torch.Tensor], torch.Tensor]
) -> None:
    """Bent far enough, a warp comes closer to any picture, also where the fit did not look."""
    for seed, (first, second) in enumerate([(0, 12), (40, 60)]):
        reference, query = (orbit_camera(azimuth, size=SIZE) for azimuth in (first, second))
        image, truth = speckled(scene, reference), wrong(speckled(scene, query))
        depth = scene.depth(reference) * smooth_error(seed)
        found = correct_pair(View(image, reference, depth), View(truth, query), FLOW, GRID)
        assert "off their epipolar lines" in found.reason
        assert found.flow is None


def test_errors_are_compared_over_what_both_warps_show() -> None:
    reference, query = orbit_camera(0, size=SIZE), orbit_camera(15, size=SIZE)
    image, truth = (speckled(SPHERE_ON_PLANE, camera) for camera in (reference, query))
    depth = SPHERE_ON_PLANE.depth(reference)
    whole = drawn(image, depth, reference, query)
    wrong = image.clone()
    wrong[:, :, SIZE // 2 :] = 0
    half_wrong = drawn(wrong, depth, reference, query)
    right_part = depth.clone()
    right_part[:, SIZE // 2 :] = 0
    part = drawn(image, right_part, reference, query)
    assert errors_in_common(whole, whole, truth)[0] == photometric_error(whole, truth)
    in_whole = photometric_error(half_wrong, truth)
    in_common, _ = errors_in_common(half_wrong, part, truth)
    assert in_whole > 5 * in_common
