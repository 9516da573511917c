"""Videos as scenes: which of their frames are taken, and what is no scene."""

import shutil
import struct

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from extrap_train.config import SyntheticConfig
from extrap_train.data import keyframes, video_files
from extrap_train.data.image_files import to_eight_bits
from extrap_train.data.scene_spec import open_scene
from extrap_train.data.synthetic.capture import synthetic_sequence
from extrap_train.errors import InputError

SIZE = 192
STILL = 12
"""Times that the first and the middle view are shown; each other view is shown once."""
VIEWS = 14
MIDDLE = 7
WALK = SyntheticConfig(frames=90, image_size=SIZE)


@pytest.fixture(scope="module")
def walk():
    """The views of a walk, and what a video of it shows: two blurred frames after every sharp one;
    number of the view of each frame, None where it is blurred.
    """
    views = [f.load() for f in synthetic_sequence("hydrant", 0, WALK).frames[:VIEWS]]
    shown, frames = [], []
    for number, view in enumerate(views):
        picture = to_eight_bits(view.image).transpose(1, 2, 0)
        times = STILL if number in (0, MIDDLE) else 1
        blurred = cv2.GaussianBlur(picture, (0, 0), 3)
        frames += [picture] * times + [blurred] * 2
        shown += [number] * times + [None] * 2
    return views, frames, shown


def _write(file, frames, codec="mp4v"):
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*codec), 30, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame[..., ::-1])
    writer.release()
    return file


@pytest.fixture
def posing(monkeypatch, tmp_path):
    """A cache of the test's own; the folders whose cameras would be estimated, in order."""
    asked = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(keyframes, "read_unposed", lambda folder, *_: asked.append(folder))
    return asked


def test_sharp_frames_of_distinct_views_are_chosen(walk):
    _, frames, shown = walk
    chosen = keyframes.choose_frames(cv2.cvtColor(f, cv2.COLOR_RGB2GRAY) for f in frames)
    numbers = [shown[frame] for frame in chosen]
    assert None not in numbers, "a blurred frame"
    assert numbers == sorted(set(numbers)), "a view is taken twice, though the camera stood still"
    assert numbers[0] == 0
    assert VIEWS // 3 <= len(numbers) < VIEWS


def test_frames_without_texture_are_passed_over(walk):
    _, frames, _ = walk
    grey = [np.zeros((SIZE, SIZE), np.uint8)] * 30
    grey += [cv2.cvtColor(f, cv2.COLOR_RGB2GRAY) for f in frames]
    assert keyframes.choose_frames(grey)[0] >= 30


@pytest.mark.parametrize(
    ("suffix", "codec"),
    [("mp4", "mp4v"), ("mov", "mp4v"), ("avi", "MJPG"), ("mkv", "mp4v"), ("webm", "VP80")],
)
def test_containers(walk, posing, tmp_path, suffix, codec):
    """Told by content: the name says nothing."""
    file = _write(tmp_path / f"walk.{suffix}", walk[1], codec)
    open_scene(str(file.rename(tmp_path / "walk")))
    pictures = sorted(posing[0].iterdir())
    assert len(pictures) >= 3
    for path in pictures:
        there = np.asarray(Image.open(path)).astype(float)
        assert np.abs(there - walk[1][int(path.stem)]).mean() < 8  # what the codecs lose


def test_the_rotation_that_the_container_asks_for(walk, posing, tmp_path):
    file = _write(tmp_path / "walk.mp4", [frame[:128] for frame in walk[1]])
    content = file.read_bytes()
    # 'tkhd', version 0: 40 bytes later the matrix, in 16.16 fixed point.
    at = content.index(b"tkhd") + 44
    quarter_turn = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30)
    file.write_bytes(content[:at] + quarter_turn + content[at + 36 :])
    open_scene(str(file))
    for path in posing[0].iterdir():
        there = np.asarray(Image.open(path)).astype(float)
        assert there.shape == (SIZE, 128, 3)
        clockwise = np.rot90(walk[1][int(path.stem)][:128], -1)
        assert np.abs(there - clockwise).mean() < 8


def test_frames_are_chosen_again_only_for_another_video(walk, posing, tmp_path, monkeypatch):
    file = _write(tmp_path / "walk.mp4", walk[1])
    open_scene(str(file))
    monkeypatch.setattr(keyframes, "_choose", lambda file: [0, 1, 2])
    (tmp_path / "moved").mkdir()
    open_scene(str(shutil.copy(file, tmp_path / "moved")))
    assert posing[0] == posing[1]
    open_scene(str(_write(tmp_path / "walk.mp4", walk[1][:20])))
    assert posing[2] != posing[0]
    assert len(list(posing[2].iterdir())) == 3


def test_of_many_stretches_some_are_taken_at_even_distances(walk, posing, tmp_path, monkeypatch):
    file = _write(tmp_path / "walk.mp4", walk[1])
    monkeypatch.setattr(keyframes, "MAX_CHOSEN", 3)
    monkeypatch.setattr(keyframes, "_choose", lambda file: [0, 4, 9, 12, 20])
    open_scene(str(file))
    assert sorted(path.stem for path in posing[0].iterdir()) == ["000000", "000009", "000020"]


def test_what_is_no_scene(walk, posing, tmp_path, monkeypatch, capfd):
    whole = _write(tmp_path / "whole.mp4", walk[1])
    text, cut, playlist = (tmp_path / name for name in ("text.mp4", "cut.mp4", "list.mp4"))
    text.write_text("no video")
    cut.write_bytes(whole.read_bytes()[:4000])
    playlist.write_text(f"ffconcat version 1.0\nfile {whole}\n")
    still = _write(tmp_path / "still.mp4", walk[1][:STILL])
    none = tmp_path / "none.avi"
    _write(none, walk[1][:1], "MJPG")
    # Without the chunk of the only frame.
    none.write_bytes(none.read_bytes().replace(b"00dc", b"JUNK"))
    complaints = {
        text: "not a video",
        playlist: "not a video",
        cut: "truncated",
        none: "no frame",
        still: "1 distinct view",
    }
    capfd.readouterr()
    for file, expected in complaints.items():
        _expect(file, expected)
    monkeypatch.setattr(video_files, "MAX_PIXELS", 1000)
    _expect(whole, "1,000")
    assert not posing
    assert capfd.readouterr().err == ""  # nothing of FFmpeg's


def _expect(file, expected):
    with pytest.raises(InputError, match=expected) as caught:
        open_scene(str(file))
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_cameras_of_a_video(walk, tmp_path, monkeypatch):
    pytest.importorskip("pycolmap", reason="needs pycolmap: the extra `poses`")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    views, frames, shown = walk
    sequence = open_scene(str(_write(tmp_path / "walk.mp4", frames)))
    assert sequence.name == "walk"
    truth = [views[shown[int(frame.name[:6])]].camera for frame in sequence.frames]
    assert not sequence.left_out
    # A path of 60 degrees determines the world's axes only roughly: from the first frame on.
    found, true = (
        [(c.world_to_cam @ cameras[0].world_to_cam.inverse())[:3, :3] for c in cameras]
        for cameras in ([frame.camera for frame in sequence.frames], truth)
    )
    for turn, wanted in zip(found, true, strict=True):
        assert torch.arccos(((turn @ wanted.T).trace() - 1).clamp(max=2) / 2).rad2deg() < 2
