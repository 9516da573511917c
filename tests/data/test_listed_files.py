"""Files are found where other loaders would find them, and what is there instead is said."""

import unicodedata
from pathlib import Path

import pytest

from extrap_train.data.listed_files import PICTURE_SUFFIXES, ListedFiles


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "images").mkdir()
    for name in ("a.jpg", "IMG_1.JPG", "r_3.jpeg", "r_3.x", "v1.5.png", "twice.JPG", "Twice.jpg"):
        (tmp_path / "images" / name).touch()
    for name in ("top.webp", "b\\c.png"):
        (tmp_path / name).touch()
    return tmp_path


@pytest.mark.parametrize(
    ("listed", "found"),
    [
        ("images/a.jpg", "images/a.jpg"),
        ("./images//a.jpg", "images/a.jpg"),
        ("images/a", "images/a.jpg"),
        ("images/r_3", "images/r_3.jpeg"),
        ("images/v1.5", "images/v1.5.png"),
        ("images\\a.jpg", "images/a.jpg"),
        ("images\\a", "images/a.jpg"),
        (".\\images\\a.jpg", "images/a.jpg"),
        ("b\\c.png", "b\\c.png"),
        ("images/IMG_1.jpg", "images/IMG_1.JPG"),
        ("images/img_1", "images/IMG_1.JPG"),
        ("images\\IMG_1.jpg", "images/IMG_1.JPG"),
        ("images/twice.JPG", "images/twice.JPG"),
        ("images/TWICE.jpg", None),
        ("images/b.jpg", None),
        ("images", None),
        ("x" * 254, None),
    ],
)
def test_where_a_listed_file_is(root, listed, found):
    assert ListedFiles(root).find(listed, PICTURE_SUFFIXES) == found


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_accents_may_be_composed_in_either_way(tmp_path, form):
    other = {"NFC": "NFD", "NFD": "NFC"}[form]
    (tmp_path / unicodedata.normalize(form, "Bild ä0.png")).touch()
    listed = unicodedata.normalize(other, "Bild ä0.png")
    assert ListedFiles(tmp_path).find(listed) == unicodedata.normalize(form, listed)


def test_no_suffix_is_added_unasked(root):
    assert ListedFiles(root).find("images/a") is None


@pytest.mark.parametrize(
    ("listed", "there"),
    [
        ("images/a.png", "images/a.jpg"),
        ("images/IMG_11.JPG", "images/IMG_1.JPG"),
        ("a.jpg", "images/a.jpg"),
        ("train/a.jpg", "images/a.jpg"),
        ("images/top.webp", "top.webp"),
        ("train/zzz.tif", "no folder train"),
        ("images/zzz.tif", "no images/zzz.tif"),
        ("images", "not a regular file"),
    ],
)
def test_what_is_there_instead(root, listed, there):
    assert there in ListedFiles(root).explain(listed)
