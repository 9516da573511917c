import torch
from traced_scenes import orbit_camera

from extrap_train.depth.neighbours import choose_neighbours, convergence_point
from extrap_train.views import Camera


def chosen(azimuths_deg: list[float], count: int) -> list[list[float]]:
    cameras = [orbit_camera(azimuth_deg, 64) for azimuth_deg in azimuths_deg]
    indices = choose_neighbours(cameras, convergence_point(cameras), count)
    return [[azimuths_deg[i] for i in row] for row in indices]


def test_both_sides_at_useful_angles():
    for start, row in zip(range(0, 360, 2), chosen(list(range(0, 360, 2)), 4), strict=True):
        offsets = [(azimuth - start + 180) % 360 - 180 for azimuth in row]
        assert len(row) == 4
        assert sum(offset > 0 for offset in offsets) == 2
        assert all(6 <= abs(offset) <= 20 for offset in offsets)


def test_the_end_of_an_arc_takes_what_there_is():
    assert set(chosen([0, 12, 24, 80], 4)[0]) == {12, 24}


def test_neither_the_same_place_nor_the_far_side():
    rows = chosen([0, 1, 15, 90], 4)
    assert rows[0] == [15]
    assert rows[3] == []


def test_cameras_in_a_row_far_from_the_origin_take_those_beside_them():
    """Forty that look the same way, a unit apart, 10 km from the origin of a map."""
    intrinsics = torch.tensor([[64.0, 0, 32], [0, 64, 32], [0, 0, 1]])
    cameras = []
    for x in range(40):
        world_to_cam = torch.eye(4)
        world_to_cam[:3, 3] = -torch.tensor([10_000.0 + x, 10_000.0, 0.0])
        cameras.append(Camera(world_to_cam, intrinsics, 64, 64))
    assert convergence_point(cameras) is None
    rows = choose_neighbours(cameras, None, 2)
    inner = {index: {index - 1, index + 1} for index in range(1, 39)}
    assert {0: set(rows[0]), 39: set(rows[39])} == {0: {1, 2}, 39: {37, 38}}
    assert {index: set(rows[index]) for index in inner} == inner
