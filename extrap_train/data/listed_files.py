"""Finds files where other loaders would: those that a description lists, and photographs' masks."""

import difflib
import logging
import os
import posixpath
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path

from extrap_train.errors import InputError

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
"""Tried, in this order, where a name has none."""
_MAX_COMPARED = 2000
"""Names of a folder that a missing one is compared with."""
_IMAGES = re.compile(r"images(_\d+)?")
"""Folders of pictures, whole or reduced, that masks lie beside."""
_NUMBER = re.compile("([0-9]+)")
_MASK_ENDINGS = tuple(f"_mask{suffix}" for suffix in PICTURE_SUFFIXES)

log = logging.getLogger(__name__)


class ListedFiles:
    """The files below one folder, by the paths that a description gives them.

    Paths have passed `check_relative`. A folder is listed once, and only where a file is missing.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._folders: dict[str, dict[str, list[str]]] = {}

    def find(self, listed: str, suffixes: Sequence[str] = ()) -> str | None:
        """The path below the root that `listed` means, None where there is no such file.

        Tried in turn: the path itself; `\\` as a stroke; with one of the `suffixes` added; and each
        of these in another case or Unicode form, where only one file is called so.
        """
        spellings = [listed, listed.replace("\\", "/")] if "\\" in listed else [listed]
        candidates = [
            posixpath.normpath(spelling) + suffix
            for spelling in spellings
            for suffix in ("", *suffixes)
        ]
        if _is_file(self.root / candidates[0]):
            return candidates[0]
        return next(self.present(candidates), None)

    def present(self, paths: Iterable[str]) -> Iterator[str]:
        """Those of the paths that are files; then those that are in another case or Unicode form,
        where only one file is called so.
        """
        alike = [(posixpath.split(path), self._alike(path)) for path in paths]
        exact = [posixpath.join(*path) for path, names in alike if path[1] in names]
        other = [posixpath.join(path[0], names[0]) for path, names in alike if len(names) == 1]
        return (path for path in (*exact, *other) if _is_file(self.root / path))

    def explain(self, listed: str) -> str:
        """What is there instead of a file that was not found."""
        path = normal_path(listed)
        if os.path.lexists(self.root / path):
            return f"{path} is not a regular file"
        folder, name = posixpath.split(path)
        looked_in = {folder: None, "": None, "images": None}
        for place in looked_in:
            alike = _look_alike(name, self._in(place).values())
            if alike is not None:
                return f"there is no {path}; there is {posixpath.join(place, alike)}"
        if folder and not (self.root / folder).is_dir():
            return f"there is no folder {folder}"
        return f"there is no {path}"

    def _alike(self, path: str) -> list[str]:
        """The names in the path's folder that are its own but for case and Unicode form."""
        folder, name = posixpath.split(path)
        return self._in(folder).get(_folded(name), [])

    def _in(self, folder: str) -> dict[str, list[str]]:
        """The names in a folder, by their folded form."""
        if folder not in self._folders:
            names = self._folders.setdefault(folder, {})
            try:
                for path in sorted((self.root / folder).iterdir()):
                    names.setdefault(_folded(path.name), []).append(path.name)
            except OSError:
                pass  # nothing is in a folder that is not there
        return self._folders[folder]


class MaskFiles:
    """The masks of the pictures below one folder, by the names that other tools give them.

    Below `masks`, in the pictures' folder or beside `images`, that of `images/a/1.jpg` is
    `images/a/1.jpg.png` or `a/1.jpg.png` (COLMAP), `1.png` or another picture of that name
    (nerfstudio), or `1_mask.png`; or it is `1_mask.png` beside the picture. Those of `images_2` may
    lie below `masks_2`. None of the `pictures` themselves is a mask.
    """

    def __init__(self, root: Path, pictures: Iterable[str]) -> None:
        self._root = root.absolute()  # links stay: masks are beside the link
        self._pictures = {self._root / picture for picture in pictures}
        self._folders: dict[Path, ListedFiles] = {}
        self._without: list[str] = []
        self._found: dict[Path, list[str]] = {}

    def find(self, picture: str) -> Path | None:
        """The mask of the picture at this path below the folder; None where there is none."""
        stem, suffix = posixpath.splitext(picture)
        first, _, rest = stem.partition("/")
        places = [(self._root / "masks", stem)]
        if rest and _IMAGES.fullmatch(first):
            places += [(self._root / _masks(first), rest), (self._root / "masks", rest)]
        if _IMAGES.fullmatch(self._root.name):
            beside = self._root.parent
            places += [(beside / "masks", f"{self._root.name}/{stem}")]
            places += [(beside / _masks(self._root.name), stem), (beside / "masks", stem)]
        endings = (f"{suffix}.png", *PICTURE_SUFFIXES, *_MASK_ENDINGS)
        tried = [(folder, name, endings) for folder, name in places if folder.is_dir()]
        for folder, name, suffixes in (*tried, (self._root, stem, _MASK_ENDINGS)):
            files = self._folders.setdefault(folder, ListedFiles(folder))
            for found in files.present([name + suffix for suffix in suffixes]):
                mask = folder / found
                if mask not in self._pictures:
                    self._found.setdefault(mask, []).append(picture)
                    return mask
        self._without.append(picture)
        return None

    def require_distinct(self) -> None:
        """InputError where one file was found as the mask of two pictures."""
        for mask, pictures in self._found.items():
            if len(pictures) > 1:
                first, second = pictures[:2]
                raise InputError(
                    f"{mask}: its name makes it the mask of both {first} and {second}; provide "
                    f"masks/{first}.png and masks/{second}.png instead"
                )

    def warn_of_missing(self) -> None:
        """Warn where there are masks and pictures without one."""
        folders = [folder for folder in self._folders if folder != self._root]
        if not self._without or not (self._found or folders):
            return
        found = sum(map(len, self._found.values()))
        name = posixpath.basename(self._without[0])
        stem = posixpath.splitext(name)[0]
        log.warning(
            "%s: %d of %d pictures have a mask, and the whole picture counts where there is none; "
            "that of %s would be %s.png, %s.png or %s_mask.png",
            folders[0] if folders else self._root,
            found,
            found + len(self._without),
            name,
            name,
            stem,
            stem,
        )


def is_mask_name(name: str, names: Iterable[str]) -> bool:
    """Whether a picture is called as the mask of another of the `names` beside it."""
    stem = posixpath.splitext(name)[0]
    own = stem.removesuffix("_mask")
    return own != stem and any(posixpath.splitext(other)[0] == own for other in names)


def _masks(folder: str) -> str:
    return folder.replace("images", "masks", 1)


def normal_path(listed: str) -> str:
    """The same for paths that differ in strokes and detours alone."""
    return posixpath.normpath(listed.replace("\\", "/"))


def counting_order(path: str) -> tuple[list[str | int], str]:
    """A key by which paths are sorted in the order of the numbers in them: `2.jpg`, `10.jpg`."""
    parts = _NUMBER.split(path)  # texts and numbers take turns
    return [int(part) if place % 2 else part for place, part in enumerate(parts)], path


def _folded(name: str) -> str:
    """The same for names that differ in case or in how accents are composed."""
    return unicodedata.normalize("NFC", name).casefold()


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # longer than any path
        return False


def _look_alike(name: str, names: Iterable[Sequence[str]]) -> str | None:
    """A name of the same stem, else one that differs in little."""
    few = [other for alike in islice(names, _MAX_COMPARED) for other in alike]
    stem = posixpath.splitext(name)[0].casefold()
    same = [other for other in few if posixpath.splitext(other)[0].casefold() == stem]
    near = same or difflib.get_close_matches(name, few, n=1, cutoff=0.8)
    return near[0] if near else None
