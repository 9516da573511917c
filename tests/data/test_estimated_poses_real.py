"""Cameras estimated from real photographs, against those that their data sets give."""

import shutil

import numpy as np
import pytest
import torch
from aligned_cameras import pose_errors

from extrap_train.data.co3d import read_sequence
from extrap_train.data.scene_spec import open_scene
from extrap_train.views import Camera

pytest.importorskip("pycolmap", reason="needs pycolmap: the extra `poses`")
pytestmark = pytest.mark.slow


def test_the_apple(shared, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    sequence = read_sequence(shared / "data" / "co3d", "apple", "apple_20_frames")
    (tmp_path / "apple").mkdir()
    for frame in sequence.frames:
        shutil.copy(frame.files[0], tmp_path / "apple")
    _check(tmp_path / "apple", {frame.name: frame.camera for frame in sequence.frames})


def test_the_temple_and_the_same_bits_again(shared, tmp_path, monkeypatch):
    folder = shared / "data" / "templeSparseRing"
    cameras = {}
    for line in (folder / "templeSR_par.txt").read_text().splitlines()[1:]:
        name, *numbers = line.split()
        intrinsics, rotation = torch.tensor(list(map(float, numbers[:18]))).reshape(2, 3, 3)
        world_to_cam = torch.eye(4)
        world_to_cam[:3, :3], world_to_cam[:3, 3] = (
            rotation,
            torch.tensor(list(map(float, numbers[18:]))),
        )
        cameras[name] = Camera(world_to_cam, intrinsics, 480, 640)
    found = []
    for place in ("one", "two"):
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / place))
        found.append(_check(folder, cameras))
    for one, two in zip(*found, strict=True):
        assert torch.equal(one.world_to_cam, two.world_to_cam)
        assert torch.equal(one.intrinsics, two.intrinsics)


def _check(folder, known):
    frames = open_scene(str(folder)).frames
    assert len(frames) == len(known)
    found = [frame.camera for frame in frames]
    errors = pose_errors(found, [known[frame.name] for frame in frames])
    assert np.median(errors.rotation_deg) < 0.5
    assert np.median(errors.translation) < 0.01  # of the orbit's radius
    return found
