"""What a mirrored camera takes is what the camera took, mirrored."""

import scenes
import torch
from torch.nn import functional

from extrap_train.geometry.cameras import project, unproject_to_world
from extrap_train.geometry.mirror import MirrorPlane, mirrored_view
from extrap_train.views import View

PLANE = MirrorPlane(functional.normalize(torch.tensor([0.8, -0.1, 0.5]), dim=0), torch.tensor(-0.2))
SCENE = scenes.Scene((scenes.sphere(0.6), scenes.plane(0.6, (0.0, 1.0, 0.0)), scenes.plane(5.0)))


def test_reflecting_twice_is_nothing_and_points_on_the_plane_stay():
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    twice = PLANE.reflect(PLANE.reflect(points))
    torch.testing.assert_close(twice, points)
    halfway = (points + PLANE.reflect(points)) / 2
    torch.testing.assert_close(halfway @ PLANE.normal, PLANE.offset.expand(50))
    torch.testing.assert_close(PLANE.reflect(halfway), halfway)


def test_a_batch_of_planes_reflects_as_each_of_them():
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(1))
    normals = functional.normalize(torch.randn(4, 3, generator=torch.Generator().manual_seed(2)))
    offsets = torch.linspace(-1, 1, 4)
    one_by_one = [MirrorPlane(n, o).reflect(points) for n, o in zip(normals, offsets, strict=True)]
    torch.testing.assert_close(
        MirrorPlane(normals, offsets).reflect(points), torch.stack(one_by_one)
    )


def test_a_mirrored_view_shows_the_mirrored_points_where_the_flipped_picture_has_them():
    camera = scenes.orbit_camera(40.0, size=48)
    shifted = camera.intrinsics.clone()
    shifted[0, 2] += 3.5  # a principal point off the middle
    camera = type(camera)(camera.world_to_cam, shifted, camera.height, camera.width)
    view = View(SCENE.image(camera), camera, SCENE.depth(camera), mask=torch.rand(48, 48))
    mirrored = mirrored_view(view, PLANE)
    assert torch.linalg.det(mirrored.camera.world_to_cam[:3, :3]) > 0, "an ordinary camera"
    assert (view.depth > 0).all(), "the ground fills the picture"
    points = unproject_to_world(view.depth, camera)
    seen = unproject_to_world(mirrored.depth, mirrored.camera).flip(1)
    reflected = PLANE.reflect(points.flatten(0, 1)).view_as(points)
    torch.testing.assert_close(seen, reflected, atol=1e-4, rtol=1e-4)
    pixels, depth = project(reflected.flatten(0, 1), mirrored.camera)
    own, own_depth = project(points.flatten(0, 1), camera)
    torch.testing.assert_close(depth, own_depth, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(pixels[:, 0], 48 - own[:, 0], atol=1e-3, rtol=0)
    torch.testing.assert_close(mirrored.image.flip(-1), view.image)
    torch.testing.assert_close(mirrored.mask.flip(-1), view.mask)
