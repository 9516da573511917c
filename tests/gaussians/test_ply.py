"""PLY files hold what viewers expect, come back as they were, and bad ones are named."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from splats import random_gaussians

from extrap_train.errors import InputError
from extrap_train.gaussians.ply import read_comments, read_splats, write_splats


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_comes_back_as_it_was(tmp_path, degree):
    gaussians = random_gaussians(20, degree)
    write_splats(tmp_path / "new" / "splats.ply", gaussians)
    back = read_splats(tmp_path / "new" / "splats.ply")
    assert back.sh_degree == degree
    assert torch.equal(back.means, gaussians.means)
    assert torch.equal(back.sh, gaussians.sh)
    assert torch.allclose(back.scales, gaussians.scales, rtol=1e-5)
    assert torch.allclose(back.opacities, gaussians.opacities, atol=1e-6)
    unit = gaussians.quats / gaussians.quats.norm(dim=1, keepdim=True)
    assert torch.allclose(back.quats, unit, atol=1e-6)


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_worlds_of_any_unit_come_back(tmp_path, unit):
    gaussians = random_gaussians(20, 0)
    scaled = replace(gaussians, means=unit * gaussians.means, scales=unit * gaussians.scales)
    write_splats(tmp_path / "s.ply", scaled)
    back = read_splats(tmp_path / "s.ply")
    assert torch.allclose(back.scales / unit, gaussians.scales, rtol=1e-4)
    assert torch.allclose(back.means / unit, gaussians.means)


def test_layout_is_that_of_the_viewers(tmp_path):
    gaussians = random_gaussians(3, degree=1)
    write_splats(tmp_path / "s.ply", gaussians)
    header = (tmp_path / "s.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert header[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 3"]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"] + [
        f"f_rest_{i}" for i in range(9)
    ]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert header[3:] == [f"property float {name}" for name in names]
    vertex = PlyData.read(tmp_path / "s.ply")["vertex"][1]
    assert vertex["f_dc_2"] == gaussians.sh[1, 0, 2]
    assert vertex["f_rest_4"] == gaussians.sh[1, 2, 1]  # green's second of three
    assert 1 / (1 + np.exp(-vertex["opacity"])) == pytest.approx(gaussians.opacities[1].item())
    assert np.exp(vertex["scale_2"]) == pytest.approx(gaussians.scales[1, 2].item())


def test_the_viewer_of_the_3dgs_authors_reads_it_beside_comments(tmp_path):
    """By the rules of its loader: three lines, whatever up to `end_header`, and rows of one struct,
    whose colours are channel by channel behind the constant ones."""
    gaussians = random_gaussians(5, degree=3)
    write_splats(tmp_path / "s.ply", gaussians, comments=["fitted to 9 views"])
    with (tmp_path / "s.ply").open("rb") as file:
        assert file.readline() == b"ply\n"
        assert file.readline() == b"format binary_little_endian 1.0\n"
        assert file.readline().split() == [b"element", b"vertex", b"5"]
        while file.readline() != b"end_header\n":
            pass
        rows = np.frombuffer(file.read(), "<f4").reshape(5, 3 + 3 + 48 + 1 + 3 + 4)
    position, _, colors, opacity, scale, rotation = np.split(rows, [3, 6, 54, 55, 58], 1)
    assert np.array_equal(position, gaussians.means)
    assert np.array_equal(colors[:, :3], gaussians.sh[:, 0])
    assert np.array_equal(colors[:, 3:].reshape(5, 3, 15).swapaxes(1, 2), gaussians.sh[:, 1:])
    assert np.allclose(1 / (1 + np.exp(-opacity[:, 0])), gaussians.opacities, atol=1e-6)
    assert np.allclose(np.exp(scale), gaussians.scales, rtol=1e-5)
    assert np.allclose(np.linalg.norm(rotation, axis=1), 1, atol=1e-6)
    assert "fitted to 9 views" in read_comments(tmp_path / "s.ply")


def test_opaque_and_flat_ones_stay_finite(tmp_path):
    gaussians = random_gaussians(2)
    gaussians.opacities[:] = torch.tensor([0.0, 1.0])
    gaussians.scales[:, 2] = 0
    write_splats(tmp_path / "s.ply", gaussians)
    assert torch.allclose(read_splats(tmp_path / "s.ply").opacities, gaussians.opacities, atol=1e-5)


def test_none_at_all(tmp_path):
    write_splats(tmp_path / "s.ply", random_gaussians(0, degree=2))
    assert len(read_splats(tmp_path / "s.ply")) == 0


def test_point_cloud_is_named(tmp_path):
    points = np.zeros(2, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    PlyData([PlyElement.describe(points, "vertex")]).write(tmp_path / "points.ply")
    with pytest.raises(InputError, match=r"lacks f_dc_0.*no 3DGS file"):
        read_splats(tmp_path / "points.ply")


def test_bad_files_are_named(tmp_path):
    path = tmp_path / "s.ply"
    with pytest.raises(InputError, match="no such file"):
        read_splats(path)
    path.write_bytes(b"no ply at all")
    with pytest.raises(InputError, match="is not a PLY file"):
        read_splats(path)
    gaussians = random_gaussians(4)
    write_splats(path, gaussians)
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(InputError, match="is not a PLY file"):
        read_splats(path)
    gaussians.means[2, 1] = float("nan")
    write_splats(path, gaussians)
    with pytest.raises(InputError, match="1 Gaussians hold NaN"):
        read_splats(path)
