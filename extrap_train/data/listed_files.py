"""Finds the files that a description lists where other loaders would find them."""

import difflib
import os
import posixpath
import unicodedata
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
"""Tried, in this order, where a name has none."""
_MOST_COMPARED = 2000
"""Names of a folder that a missing one is compared with."""


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
        alike = [(posixpath.split(path), self._alike(path)) for path in candidates]
        exact = [posixpath.join(*path) for path, names in alike if path[1] in names]
        other = [posixpath.join(path[0], names[0]) for path, names in alike if len(names) == 1]
        there = (path for path in (*exact, *other) if _is_file(self.root / path))
        return next(there, None)

    def explain(self, listed: str) -> str:
        """What is there instead of a file that was not found."""
        path = posixpath.normpath(listed.replace("\\", "/"))
        if os.path.lexists(self.root / path):
            return f"{path} is no regular file"
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
    few = [other for alike in islice(names, _MOST_COMPARED) for other in alike]
    stem = posixpath.splitext(name)[0].casefold()
    same = [other for other in few if posixpath.splitext(other)[0].casefold() == stem]
    near = same or difflib.get_close_matches(name, few, n=1, cutoff=0.8)
    return near[0] if near else None
