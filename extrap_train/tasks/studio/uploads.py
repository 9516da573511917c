"""Photographs that a visitor drops on the page: checked one by one, kept in a folder of their own.

Over the websocket the page sends a photograph's name as text, then its content, and gets back an
empty text or the line that says why it was refused. An empty name ends the upload; the answer is
then empty or says why nothing is kept.
"""

import asyncio
import re
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from threading import Lock

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from extrap_train.data.estimated_poses import PHOTOGRAPH_SUFFIXES
from extrap_train.data.image_files import upright_photograph
from extrap_train.data.structure_from_motion import MIN_PICTURES
from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_folder, remove_leftovers
from extrap_train.tasks.scene_inputs import require_space

MAX_PHOTOGRAPHS = 200
MAX_BYTES = 40_000_000
"""Of one photograph."""
MAX_BYTES_TOGETHER = 2_000_000_000
_NAME = re.compile(r"\w[\w ()+,.-]{0,99}")


class Upload:
    """Photographs on their way into an empty folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._names: set[str] = set()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._names)

    def add(self, name: str, content: bytes) -> None:
        """Keep a photograph; InputError, and nothing kept, if it is none or one too many."""
        plain = name.isprintable() and _NAME.fullmatch(name) and name.casefold() not in self._names
        if not plain or not name.lower().endswith(PHOTOGRAPH_SUFFIXES):
            raise InputError(
                f"{name[:100]!a}: is no name of its own for a photograph; use letters, digits and "
                f"- _ . and one of {', '.join(PHOTOGRAPH_SUFFIXES)}"
            )
        if len(self) == MAX_PHOTOGRAPHS:
            raise InputError(f"{name}: at most {MAX_PHOTOGRAPHS} photographs are taken at a time")
        if len(content) > MAX_BYTES or self._bytes + len(content) > MAX_BYTES_TOGETHER:
            raise InputError(
                f"{name}: a photograph may have {MAX_BYTES // 10**6} MB, and all together "
                f"{MAX_BYTES_TOGETHER // 10**6} MB; send smaller ones"
            )
        require_space(self.folder, 2 * len(content))
        path = self.folder / name
        path.write_bytes(content)
        try:
            upright_photograph(path)
        except InputError as error:
            path.unlink()
            raise InputError(str(error).replace(f"{self.folder}/", "")) from None
        self._names.add(name.casefold())
        self._bytes += len(content)


class Receiver:
    """The page's websocket for photographs: one upload at a time, each in a new folder.

    `on_received` is called with the folder, once all of its photographs are there.
    """

    def __init__(self, parent: Path, on_received: Callable[[Path], None]) -> None:
        self._parent, self._on_received = parent, on_received
        self._taken = Lock()
        remove_leftovers(parent)

    async def __call__(self, connection: ServerConnection) -> None:
        """Serve one connection; whatever it breaks off leaves nothing."""
        if not self._taken.acquire(blocking=False):
            await connection.close(1013, "another upload is under way")
            return
        try:
            folder = _next_folder(self._parent)
            with ExitStack() as stack:
                upload = Upload(stack.enter_context(atomic_folder(folder)))
                await _receive(connection, upload)
            self._on_received(folder)
            await connection.send("")
        except InputError as error:
            await connection.send(str(error))
        except ConnectionClosed:
            pass
        finally:
            self._taken.release()


async def _receive(connection: ServerConnection, upload: Upload) -> None:
    while name := await connection.recv():
        content = await connection.recv()
        if not isinstance(name, str) or not isinstance(content, bytes):
            raise InputError("expected a photograph's name as text, then its content as bytes")
        try:
            await asyncio.to_thread(upload.add, name, content)
        except InputError as error:
            await connection.send(str(error))
        else:
            await connection.send("")
    if len(upload) < MIN_PICTURES:
        raise InputError(
            f"{len(upload)} photographs were taken, and cameras are estimated from at least "
            f"{MIN_PICTURES}: drop more at a time"
        )


def _next_folder(parent: Path) -> Path:
    """`photographs-1`, or the first number after those that are there."""
    taken = [path.name.removeprefix("photographs-") for path in parent.glob("photographs-*")]
    number = max((int(end) for end in taken if end.isdecimal()), default=0) + 1
    return parent / f"photographs-{number}"
