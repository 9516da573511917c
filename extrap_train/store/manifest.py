"""A result's manifest, which says what it was made from, and its folder, which one process holds
while it decides whether to reuse, replace or refuse it.
"""

import json
import os
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_folder, file_lock, link_target, remove_leftovers
from extrap_train.store.records import read_record, write_record
from extrap_train.terminal import terminal

MANIFEST = "manifest.json"
"""The manifest's file in the folder of every result."""

PUBLISHED = "published"
"""The source of captures that nobody here can name: those of weights that others have trained."""
_PACKAGES = ("torch", "lightning", "diffusers", "numba", "numpy")
_MAX_NAMED = 6


@dataclass(frozen=True)
class Split:
    """The captures of one category that a model is trained on, and those held out for testing."""

    source: str
    """`synthetic`, `co3d`, `uco3d`, `folders` or `PUBLISHED`: captures of different sources are
    different, whatever their names.
    """
    train: tuple[str, ...]
    test: tuple[str, ...]
    seed: int | None = None
    """Seed of rendered captures: the same name under another seed is another object."""


@dataclass(frozen=True)
class Manifest:
    """What a result follows from. Code and package versions are recorded and not compared."""

    options: Mapping[str, Any]
    """Values by dotted key, as JSON holds them."""
    inputs: Mapping[str, str]
    """SHA-256 of the content of everything that is read, by a name that a user recognises."""
    split: Mapping[str, Split]
    """By category; empty where nothing is trained."""
    code: str
    packages: Mapping[str, str | None]

    @classmethod
    def of(
        cls,
        options: Mapping[str, Any],
        inputs: Mapping[str, str] | None = None,
        split: Mapping[str, Split] | None = None,
    ) -> "Manifest":
        """A result's manifest, with the versions that run now."""
        plain = json.loads(json.dumps(options))  # tuples become lists, as they will be read back
        return cls(plain, inputs or {}, split or {}, code_version(), package_versions())

    def differences(self, before: "Manifest") -> list[str]:
        """Each option, input and category that was another, in words; empty for the same result."""
        was, now = before.options, self.options
        found = [
            f"{key} (was {was.get(key, 'not set')}, now {now.get(key, 'not set')})"
            for key in {**now, **was}
            if was.get(key) != now.get(key)
        ]
        found += [
            f"{name} ({'other content' if name in self.inputs else 'no longer read'})"
            for name in {**self.inputs, **before.inputs}
            if before.inputs.get(name) != self.inputs.get(name)
        ]
        found += [
            f"split of {category} ({_split_change(before.split.get(category), split)})"
            for category, split in {**dict.fromkeys(before.split), **self.split}.items()
            if split != before.split.get(category)
        ]
        more = len(found) - _MAX_NAMED
        return found if more <= 1 else [*found[:_MAX_NAMED], f"and {more} more"]


def _split_change(before: Split | None, now: Split | None) -> str:
    if before is None or now is None:
        return "new" if before is None else "no longer there"
    moved = sorted({*before.test} & {*now.train} | {*before.train} & {*now.test})
    return f"{len(moved)} captures changed sides: {moved[0]}" if moved else "other captures"


@cache
def package_version(name: str) -> str | None:
    """The version of an installed package; None if it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def package_versions() -> dict[str, str | None]:
    """The versions of the packages that results depend on most."""
    return {name: package_version(name) for name in _PACKAGES}


@cache
def code_version() -> str:
    """This package's version and, in a git checkout of it, the commit."""
    installed = package_version("extrap-train") or "unknown"
    checkout = Path(__file__).parents[2]
    if not (checkout / ".git").exists():
        return installed
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError):  # no git, or a checkout of somebody else
        return installed
    return f"{installed}+{said.stdout.strip()}"


REMEDY = "use run=NAME for a new folder or resume=false to replace it"
_LEFT_ALONE = (
    "what lies there is not known to be a result and is left alone: move it, or give another run= "
    "or output="
)


class Conflict(InputError):
    """A result lies where another is to be written."""


@dataclass(frozen=True)
class Claim:
    """A result's folder that this process holds.

    `is_reused` says that a result of the same manifest lies there, perhaps unfinished: read it or
    go on with it. Otherwise call `begin` and fill the folder, or write all of it within `replace`.
    """

    folder: Path
    manifest: Manifest
    is_reused: bool

    def begin(self) -> None:
        """Put a folder with nothing but the manifest in the place of whatever lies there."""
        with self.replace():
            pass

    @contextmanager
    def replace(self) -> Iterator[Path]:
        """A new folder that takes the result's place at the end, or leaves no trace."""
        with atomic_folder(self.folder) as made:
            yield made
            write_record(made / MANIFEST, self.manifest)


@contextmanager
def claim(
    folder: Path, manifest: Manifest, *, resume: bool, remedy: str = REMEDY
) -> Iterator[Claim]:
    """Hold a result's folder for this process alone as long as the block lasts.

    A link is followed. Leftovers of killed writers are removed. With `resume`, what lies there must
    be of the same manifest (`Conflict`), unless nothing but the manifest is there; without, it is
    to be replaced. Raises InputError if another process holds the folder, or if anything lies there
    that does not say that it is a result, which is left alone.
    """
    place = link_target(folder)
    place.parent.mkdir(parents=True, exist_ok=True)
    taken = f"{folder}: another process is writing this result; wait for it or give run=NAME"
    with file_lock(place.with_name(f".{place.name}.lock"), taken):
        is_empty = place.is_dir() and not any(place.iterdir())
        is_there = os.path.lexists(place) and not is_empty
        if is_there:
            read_manifest(folder, _LEFT_ALONE)
            # What was begun and failed at once left nothing that could be lost.
            is_there = [path.name for path in place.iterdir()] != [MANIFEST]
        if is_there and resume:
            require_same(folder, manifest, remedy)
        remove_leftovers(place.parent, of=place.name if folder.is_symlink() else "")
        for part in (place, *(path for path in place.rglob("*") if path.is_dir())):
            remove_leftovers(part)
        with _held(place.with_name(f".{place.name}.held"), folder):
            yield Claim(place, manifest, is_there and resume)


@contextmanager
def _held(mark: Path, folder: Path) -> Iterator[None]:
    """Leave a mark as long as the block lasts; one that is there was left by a killed process."""
    if mark.exists():
        terminal(stderr=True).print(
            f"note: {folder}: the last command here was killed without a word, as by the system "
            "where memory ends (smaller batches take less); what it finished is kept"
        )
    mark.touch()
    try:
        yield
    finally:
        mark.unlink(missing_ok=True)


def require_same(folder: Path, manifest: Manifest, remedy: str = REMEDY) -> None:
    """Raise `Conflict` unless the result in a folder was made from the same."""
    before = read_manifest(folder, remedy)
    if differences := manifest.differences(before):
        raise Conflict(f"{folder}: made with different {', '.join(differences)}; {remedy}")


def read_manifest(folder: Path, remedy: str = REMEDY) -> Manifest:
    """What the result in a folder was made from; InputError if that is missing or damaged."""
    return read_record(folder / MANIFEST, Manifest, remedy)
