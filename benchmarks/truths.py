"""The truths of a table out of reach while methods run: whoever walks the disk finds none."""

import shutil
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from extrap_train.store.atomic import atomic_folder


@contextmanager
def put_away(truths: Path) -> Iterator[None]:
    """Remove a folder of truths, and put it back at the end of the block, however that ends.

    Meanwhile they lie in a file that has no name and is open in this process alone. Where this
    process is killed they are gone, and the next run prepares them again.
    """
    with tempfile.TemporaryFile(dir=truths.parent) as kept:
        with tarfile.open(fileobj=kept, mode="w") as archive:
            archive.add(truths, arcname="")
        shutil.rmtree(truths)
        try:
            yield
        finally:
            kept.seek(0)
            with tarfile.open(fileobj=kept) as archive, atomic_folder(truths) as made:
                archive.extractall(made, filter="data")
