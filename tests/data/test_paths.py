"""The text of a path from outside is checked; the user's own links are followed."""

import os
import socket
from pathlib import Path

import pytest

from extrap_train.data.json_files import read_json
from extrap_train.data.paths import check_relative, require_file
from extrap_train.data.transforms_json import read_transforms
from extrap_train.errors import InputError


@pytest.mark.parametrize(
    "path", ["a.jpg", "a/b.jpg", "a..b/..c", "...", "a b/ü.png", "at 10.00.00\u202fAM.png"]
)
def test_paths_below_the_root_are_taken(path):
    assert check_relative(path, Path("list.json")) == path


@pytest.mark.parametrize("path", ["", "/a", "..", "a/..", "a/../b", "\\\\host\\a", "c:a", "a\0"])
def test_other_paths_are_refused(path):
    with pytest.raises(InputError, match=r"list\.json: the path .* only paths below"):
        check_relative(path, Path("list.json"))


@pytest.mark.parametrize(
    "path",
    ["x" * 256, "a/" + "ü" * 128, "a/" * 3000 + "a", "a\ud800", "a\nb", "a\x1b[2Jb"],
)
def test_names_that_no_file_has_are_refused(path):
    with pytest.raises(InputError, match=r"list\.json: the path .* correct") as refused:
        check_relative(path, Path("list.json"))
    assert str(refused.value).isprintable()


def test_links_of_the_user_are_followed_wherever_they_lead(tmp_path):
    (tmp_path / "root").mkdir()
    (tmp_path / "blob").write_text("content")
    (tmp_path / "root" / "a.txt").symlink_to("../blob")
    assert require_file(tmp_path / "root" / "a.txt").read_text() == "content"


@pytest.fixture(params=["loop", "nowhere", "folder", "pipe", "socket", "device", "long"])
def no_file(tmp_path, request):
    path = tmp_path / request.param
    match request.param:
        case "loop":
            path.symlink_to("loop")
        case "nowhere":
            path.symlink_to(tmp_path / "gone")
        case "folder":
            path.mkdir()
        case "pipe":
            os.mkfifo(path)
        case "socket":
            place = os.open(tmp_path, os.O_DIRECTORY)  # a socket's own path may not be long
            with socket.socket(socket.AF_UNIX) as listening:
                listening.bind(f"/proc/self/fd/{place}/socket")
            os.close(place)
        case "device":
            path.symlink_to("/dev/zero")
        case "long":
            return tmp_path / ("a/" * 3000)
    return path


def test_what_is_no_file_is_one_line_and_is_not_waited_for(no_file):
    for read in (require_file, read_json):
        with pytest.raises(InputError) as refused:
            read(no_file)
        assert "\n" not in str(refused.value)


def test_a_pipe_is_no_transforms_json(tmp_path):
    os.mkfifo(tmp_path / "transforms.json")
    with pytest.raises(InputError, match="is not a regular file"):
        read_transforms(tmp_path)
