"""Normals and occluding edges of analytic surfaces."""

import pytest
import scenes
import torch

from extrap_train.geometry.cameras import unproject
from extrap_train.geometry.warp.surface import normals_from_depth


def test_sphere_normals_point_away_from_its_centre():
    camera = scenes.orbit_camera(0, size=128)
    depth = scenes.SPHERE.depth(camera)
    normals, valid = normals_from_depth(depth, camera)
    center = camera.world_to_cam[:3, 3]
    expected = torch.nn.functional.normalize(unproject(depth, camera) - center, dim=-1)
    off = (normals * expected).sum(-1).clamp(-1, 1).acos()[valid]
    assert valid[depth > 0].float().mean() > 0.97
    assert off.median() < 0.01
    assert not normals[~valid].any()


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e-3])
@pytest.mark.parametrize("angle_deg", [0.0, 60.0, 85.0])
def test_plane_normals_are_exact_at_any_angle(angle_deg, unit):
    camera = scenes.orbit_camera(0, size=64, elevation_deg=0)
    angle = torch.deg2rad(torch.tensor(angle_deg))
    normal = (float(angle.sin()), 0.0, -float(angle.cos()))
    depth = scenes.Scene((scenes.plane(0.0, normal),)).depth(camera) * unit
    near = (depth > 0) & (depth < 6 * unit)
    normals, valid = normals_from_depth(torch.where(near, depth, 0), camera)
    assert valid[near].float().mean() > 0.95
    assert torch.allclose(normals[valid], torch.tensor(normal), atol=2e-2)


def test_occluding_edges_are_cut():
    camera = scenes.orbit_camera(0, size=64, elevation_deg=0)
    depth = scenes.CARD_AND_PLANE.depth(camera)
    row = depth[32]
    edge = int((row.diff().abs() > 0.5).nonzero()[0])  # from the plane at `edge` to the card
    depth[:, edge] = (
        row[edge] + row[edge + 1]
    ) / 2  # a mixed pixel, as sensors and resampling make
    _, valid = normals_from_depth(depth, camera)
    assert not valid[32, edge]
    assert not valid[32, edge - 1] or row[edge - 1] < row[edge]
    assert valid[32, edge + 1]
