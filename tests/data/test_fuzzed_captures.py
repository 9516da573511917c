"""Damaged and hostile descriptions of captures: each is read, or refused in one line.

Slow: `python -m pytest -m slow tests/data/test_fuzzed_captures.py`. The seed is fixed.
"""

import contextlib
import copy
import gzip
import json
import random
import re
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from captures import view_at, write_capture
from foreign_exports import save_picture
from posed_folders import write_transforms
from test_colmap_model import Entry, write_binary, write_text
from test_metashape import DISTORTION, LENS, transform
from test_metashape import write as write_metashape
from test_polycam import SHOTS, write_camera
from test_realitycapture import write as write_realitycapture
from test_record3d import write_metadata

from extrap_train.data.co3d import read_category
from extrap_train.data.co3d.annotations import read_sequence_split
from extrap_train.data.scene_spec import open_scene
from extrap_train.data.transforms_json import read_cameras
from extrap_train.errors import InputError

pytestmark = pytest.mark.slow

CASES = 130
"""Cases of each kind."""
SECONDS, BYTES = 20, 4 * 2**30
RUNS_SOMETHING = ("subprocess.", "os.system", "os.exec", "os.posix_spawn", "os.fork", "pickle.")

HOSTILE = [
    *(None, True, False, 0, -1, 1, 2**31, 2**63, -(2**64), 10**400, 0.5, 1e30, -1e-30, 1e308),
    *(float("nan"), float("inf"), -float("inf"), "", "x", "nan", "..", "../../etc/passwd"),
    *("/etc/passwd", "/dev/zero", "C:\\x", "a\\..\\..\\b", "a\0b", "a\nb", "\ud800", "\udc80x"),
    *("\x1b[2J", "x" * 300, "a/" * 3000, "${oc.env:HOME}", "__import__('os').system('id')"),
    *([], {}, [[]], [None] * 4, [[0.0] * 4] * 4, [[1] * 3] * 3, {"path": "/etc/passwd"}),
    *([[]] * 10_000, "OPENCV_FISHEYE", "FOV", [1e300] * 6, {"frame_type": "test_unseen"}),
]
TOKENS = ["", "nan", "inf", "-1", "0", "1e999", "9" * 400, "FOV", "é", "\0", "../x", "# x", "\x85"]


@contextlib.contextmanager
def within_limits() -> Iterator[None]:
    """A traceback where memory, time or trust runs out."""

    def late(*_: object) -> None:
        raise TimeoutError(f"took more than {SECONDS} s")

    before, old = resource.getrlimit(resource.RLIMIT_DATA), signal.signal(signal.SIGPROF, late)
    resource.setrlimit(resource.RLIMIT_DATA, (BYTES, before[1]))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)  # of this process, however busy the machine
    _watched.append(True)
    try:
        yield
    finally:
        _watched.clear()
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, old)
        resource.setrlimit(resource.RLIMIT_DATA, before)


_watched: list[bool] = []


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if _watched and event.startswith(RUNS_SOMETHING):
        raise AssertionError(f"{event} {arguments!r:.200}")


@pytest.fixture(scope="module", autouse=True)
def _audit() -> None:
    sys.addaudithook(_watch)  # cannot be taken away again; it looks at nothing else


def damage_bytes(content: bytes, rng: random.Random) -> bytes:
    """Flip, cut, repeat or insert."""
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(len(changed) + 1)
        match rng.randrange(5):
            case 0:
                del changed[at:]
            case 1:
                changed[at:at] = rng.choice((b"\0" * 8, b"\xff" * 8, rng.randbytes(9)))
            case 2:
                changed[at : at + 8] = rng.choice((b"\xff" * 8, b"\x7f" * 8, b"\0" * 8))
            case 3:
                del changed[at : at + rng.randrange(40)]
            case _:
                changed[at:at] = changed[at : at + 200]
        if not changed:
            break
    return bytes(changed)


def damage_json(content: Any, rng: random.Random) -> Any:
    """Replace or remove values anywhere in the tree, also one for all frames."""
    changed = copy.deepcopy(content)
    for _ in range(rng.choice((1, 1, 2, 5))):
        node: Any = changed
        while True:
            keys = list(node) if isinstance(node, dict) else list(range(len(node)))
            if not keys:
                break
            key = rng.choice(keys)
            if isinstance(node[key], dict | list) and node[key] and rng.random() < 0.8:
                node = node[key]
                continue
            if rng.random() < 0.15:
                del node[key]
            elif rng.random() < 0.1 and isinstance(node, list):
                node.append(copy.deepcopy(node[key]))
            else:
                node[key] = copy.deepcopy(rng.choice(HOSTILE))
            break
    return changed


def damage_text(content: str, rng: random.Random) -> str:
    """Replace words; remove, repeat and swap lines."""
    lines = [line.split(" ") for line in content.split("\n")]
    for _ in range(rng.choice((1, 1, 2, 5))):
        at = rng.randrange(len(lines))
        match rng.randrange(4):
            case 0:
                lines.insert(at, copy.copy(lines[at]))
            case 1:
                lines[at] = []
            case 2:
                other = rng.randrange(len(lines))
                lines[at], lines[other] = lines[other], lines[at]
            case _:
                if lines[at]:
                    lines[at][rng.randrange(len(lines[at]))] = rng.choice(TOKENS)
    return "\n".join(" ".join(line) for line in lines)


def dumped(content: Any) -> bytes:
    return json.dumps(content).encode()


def check(read: Callable[[], object], what: object) -> bool:
    """Whether it is read; anything but that and one clean line is a failure."""
    try:
        with within_limits():
            read()
    except InputError as refused:
        message = str(refused)
        assert "\n" not in message, what
        message.encode()
        return False
    except Exception as error:
        raise AssertionError(f"{what}: {error!r}") from error
    return True


def load_all(frames: Any) -> None:
    for frame in frames:
        with contextlib.suppress(InputError):
            frame.load()


def check_damaged_json(
    file: Path, read: Callable[[], object], whole: Any, packed: Callable[[bytes], bytes] = bytes
) -> None:
    """Damage to the tree, and to the bytes, of a JSON file that can be read as it is."""
    assert check(read, "whole")
    rng = random.Random(str(file.name))
    outcomes = set()
    for case in range(CASES):
        damaged = damage_json(whole, rng) if case % 3 else None
        content = packed(dumped(damaged) if damaged else damage_bytes(dumped(whole), rng))
        if rng.random() < 0.1:
            content = damage_bytes(content, rng)
        file.write_bytes(content)
        outcomes.add(check(read, (case, content[:300])))
    assert outcomes == {True, False}


def test_co3d_frame_annotations(tmp_path: Path) -> None:
    write_capture(tmp_path, names=("one", "two"), frames=3)
    file = tmp_path / "cup" / "frame_annotations.jgz"
    whole = json.loads(gzip.decompress(file.read_bytes()))

    def read() -> None:
        for sequence in read_category(tmp_path, "cup"):
            load_all(sequence.frames)

    check_damaged_json(file, read, whole, gzip.compress)


def test_co3d_sequence_annotations(tmp_path: Path) -> None:
    write_capture(tmp_path, names=("one", "two"), frames=2)
    file = tmp_path / "cup" / "sequence_annotations.jgz"
    whole = json.loads(gzip.decompress(file.read_bytes()))

    def read() -> None:
        for sequence in read_category(tmp_path, "cup"):
            if sequence.point_cloud:
                sequence.point_cloud.find()

    check_damaged_json(file, read, whole, gzip.compress)


def test_set_lists(tmp_path: Path) -> None:
    write_capture(tmp_path, names=("one", "two"), frames=2)
    file = tmp_path / "cup" / "set_lists" / "set_lists_manyview_dev_0.json"
    whole = json.loads(file.read_text())
    check_damaged_json(file, lambda: read_sequence_split(tmp_path, "cup", "manyview_dev_0"), whole)


@pytest.fixture
def posed(tmp_path: Path) -> Path:
    write_transforms(tmp_path / "posed", [view_at(azimuth) for azimuth in (0, 30, 60)])
    return tmp_path / "posed" / "transforms.json"


def test_transforms(posed: Path) -> None:
    whole = json.loads(posed.read_text()) | {
        **{"k1": 0.1, "k2": 0.01, "p1": 0.001, "k4": 0.0, "camera_angle_x": 0.8},
        **{"rolling_shutter": [0, 0, 0], "applied_scale": 1.0, "ply_file_path": "sparse.ply"},
    }
    check_damaged_json(posed, lambda: load_all(open_scene(str(posed.parent)).frames), whole)


def test_pose_files(posed: Path) -> None:
    whole = json.loads(posed.read_text())
    check_damaged_json(posed, lambda: read_cameras(posed), whole)


@pytest.mark.parametrize("write", [write_text, write_binary])
def test_colmap_models(tmp_path: Path, write: Callable[[Path, list[Entry]], None]) -> None:
    write_transforms(tmp_path / "posed", [view_at(azimuth) for azimuth in (0, 30, 60)])
    folder = tmp_path / "model"
    folder.mkdir()
    (tmp_path / "posed" / "images").rename(folder / "images")
    write(folder, [Entry(f"{i:03d}.png", view_at(30 * i).camera) for i in range(3)])
    whole = {file: file.read_bytes() for file in folder.iterdir() if file.is_file()}
    rng = random.Random(write.__name__)

    def read() -> None:
        load_all(open_scene(str(folder)).frames)

    assert check(read, "whole")
    outcomes = set()
    for case in range(CASES):
        file = rng.choice(sorted(whole))
        if write is write_text and case % 3:
            content = damage_text(whole[file].decode(), rng).encode()
        else:
            content = damage_bytes(whole[file], rng)
        file.write_bytes(content)
        outcomes.add(check(read, (case, file.name, content[:300])))
        file.write_bytes(whole[file])
    assert outcomes == {True, False}


def test_polycam(tmp_path: Path) -> None:
    write_camera(tmp_path / "keyframes" / "cameras", "1", SHOTS[0])
    save_picture(tmp_path / "keyframes" / "images" / "1.jpg")
    file = tmp_path / "keyframes" / "cameras" / "1.json"
    whole = json.loads(file.read_text())
    check_damaged_json(file, lambda: load_all(open_scene(str(tmp_path)).frames), whole)


def test_record3d(tmp_path: Path) -> None:
    for index in range(3):
        save_picture(tmp_path / "rgbd" / f"{index}.jpg")
    write_metadata(tmp_path)
    file = tmp_path / "metadata"
    whole = json.loads(file.read_text())
    check_damaged_json(file, lambda: load_all(open_scene(str(tmp_path)).frames), whole)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("cameras.xml", partial(write_metashape, lens=LENS | DISTORTION, of_chunk=transform())),
        ("cameras.csv", write_realitycapture),
    ],
)
def test_photogrammetry(tmp_path: Path, name: str, write: Callable[[Path], str]) -> None:
    folder, rng, outcomes = write(tmp_path), random.Random(name), set()
    whole = (tmp_path / name).read_text()
    numbers = list(re.finditer(r"-?\d[\d.e-]*", whole))
    for case in range(CASES):
        one = rng.choice(numbers)
        changed = whole[: one.start()] + rng.choice(TOKENS) + whole[one.end() :]
        content = changed.encode() if case % 2 else damage_bytes(whole.encode(), rng)
        (tmp_path / name).write_bytes(content)
        outcomes.add(check(lambda: load_all(open_scene(folder).frames), (case, content[:300])))
    assert outcomes == {True, False}
