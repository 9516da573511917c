"""What is found in a good capture, and in ones with one fault each."""

import math
from dataclasses import replace

import pytest
import torch
from traced_scenes import SCENES, orbit_camera, render

from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.geometry.foreign_cameras import flip_up_and_forward
from extrap_train.geometry.lens import Lens, undistort
from extrap_train.reconstruction.capture_check import check_capture
from extrap_train.reconstruction.check_picture import draw_check
from extrap_train.views import View

SIZE = 256
BENT, PLAIN = (Lens(1.2 * SIZE, 1.2 * SIZE, SIZE / 2, SIZE / 2, (k,)) for k in (-0.25, 0.0))


@pytest.fixture(scope="module")
def views():
    found = []
    for number in range(4):
        view = render(SCENES["box on the ground"], orbit_camera(9.0 * number, SIZE))
        points = unproject_to_world(view.depth, view.camera)
        on_box = (points[..., 1] < 0.45) & (points[..., 2] < 1)
        found.append(replace(view, mask=on_box.float(), name=f"{number}.png"))
    return found


def _changed(views, index, **changes):
    return [replace(v, **changes) if k == index else v for k, v in enumerate(views)]


def _turned(views):
    turn = torch.eye(4)
    cosine, sine = math.cos(math.radians(6)), math.sin(math.radians(6))
    turn[:2, :2] = torch.tensor([[cosine, -sine], [sine, cosine]])
    camera = views[2].camera
    moved = replace(camera, world_to_cam=turn @ camera.world_to_cam)
    return _changed(views, 2, camera=moved)


def _moved_away(views):
    """Along the line to the nearest view, which leaves their epipolar lines as they are."""
    camera = views[0].camera
    center = camera.center + 0.3 * (camera.center - views[1].camera.center)
    matrix = camera.world_to_cam.clone()
    matrix[:3, 3] = -matrix[:3, :3] @ center
    return _changed(views, 0, camera=replace(camera, world_to_cam=matrix))


def _bent(views):
    def bend(image):
        bent = undistort(image.permute(1, 2, 0).numpy(), BENT, PLAIN)
        return torch.from_numpy(bent).permute(2, 0, 1)

    return [replace(view, image=bend(view.image)) for view in views]


def _opengl(views):
    return [
        replace(v, camera=replace(v.camera, world_to_cam=_flipped(v.camera.world_to_cam)))
        for v in views
    ]


def _flipped(world_to_cam):
    return flip_up_and_forward(world_to_cam.inverse()).inverse()


def _wrong_files(views):
    found = [replace(view, depth=1.5 * view.depth) for view in views]
    found[1] = replace(found[1], mask=1 - found[1].mask)
    found[3] = replace(found[3], mask=torch.zeros(SIZE, SIZE))
    grey = View(torch.full((3, SIZE, SIZE), 0.5), orbit_camera(60.0, SIZE), name="grey.png")
    return [*found, grey]


FAULTS = {
    _turned: ["poses"],
    _moved_away: ["scale: points"],
    _bent: ["lens"],
    _opengl: ["the poses contradict"],
    _wrong_files: ["scale: depth", "masks: those of", "masks: that of 3.png", "overlap: grey.png"],
}


def test_a_right_capture_has_no_problem(views, tmp_path):
    check = check_capture([replace(views[0], depth=None, mask=None), *views[1:]])
    assert check.problems == []
    assert all(each.distance < 0.5 for each in check.matched)
    assert all(each.reprojection < 1.0 for each in check.matched)
    assert check.residuals[0] < 0.5
    assert check.residuals[1] < 1.0
    draw_check(check, tmp_path / "check.png")
    assert (tmp_path / "check.png").stat().st_size > 10_000


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named(views, fault):
    problems = check_capture(fault(views)).problems
    for expected in FAULTS[fault]:
        assert any(problem.startswith(expected) for problem in problems)
    assert not any("\n" in problem for problem in problems)
