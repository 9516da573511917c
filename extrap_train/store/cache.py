"""A result's folder: held by one process, and reused, made or refused by what it was made from."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_folder, file_lock, remove_leftovers
from extrap_train.store.manifest import MANIFEST, Manifest
from extrap_train.store.records import read_record, write_record

REMEDY = "use run=NAME for a new folder or resume=false to replace it"


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
def claim(folder: Path, manifest: Manifest, *, resume: bool) -> Iterator[Claim]:
    """Hold a result's folder for this process alone as long as the block lasts.

    Leftovers of killed writers are removed. With `resume`, what lies there must be of the same
    manifest (`Conflict`); without, it is to be replaced. Raises InputError if another process
    holds the folder.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    taken = f"{folder}: another process is writing this result; wait for it or give run=NAME"
    with file_lock(folder.with_name(f".{folder.name}.lock"), taken):
        is_reused = resume and folder.exists()
        if is_reused:
            require_same(folder, manifest)
        remove_leftovers(folder.parent)
        for part in (folder, *(path for path in folder.rglob("*") if path.is_dir())):
            remove_leftovers(part)
        yield Claim(folder, manifest, is_reused)


def require_same(folder: Path, manifest: Manifest, remedy: str = REMEDY) -> None:
    """Raise `Conflict` unless the result in a folder was made from the same."""
    before = read_manifest(folder, remedy)
    if differences := manifest.differences(before):
        raise Conflict(f"{folder}: made with different {', '.join(differences)}; {remedy}")


def read_manifest(folder: Path, remedy: str = REMEDY) -> Manifest:
    """What the result in a folder was made from; InputError if that is missing or damaged."""
    return read_record(folder / MANIFEST, Manifest, remedy)
