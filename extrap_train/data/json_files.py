"""JSON from outside, read with care; long lists one entry at a time."""

import codecs
import gzip
import json
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from extrap_train.data.paths import require_file
from extrap_train.errors import InputError

MAX_JSON_BYTES = 64 * 2**20
"""Largest file that is parsed whole: in memory JSON takes up to thirty times its text."""
MAX_ENTRY_BYTES = 64 * 2**10
"""Largest entry of a list that is read entry by entry; CO3D's have two thousand bytes."""
GZIP_FLOOR_BYTES = 32 * 2**20
GZIP_RATIO = 40
"""Annotations shrink to between a third and a tenth; a decompression bomb, to a thousandth."""
_PIECE_BYTES = 2**18
_SPACES = re.compile(r"[ \t\r\n]*")


def read_json(path: Path) -> Any:
    """The content of a JSON file; `.jgz` and `.gz` files are gzip-compressed.

    Raises InputError where it is none, no regular file, or larger than `MAX_JSON_BYTES`.
    """
    content = b"".join(_pieces(path, MAX_JSON_BYTES))
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        _refuse(path, error)


def read_json_list(path: Path, what: str) -> Iterator[Any]:
    """The entries of a JSON file that is one list; `what` names them if it is not.

    No more than an entry and a piece of the file are in memory at a time. Raises InputError as
    `read_json` does, once everything before the fault has been given.
    """
    text = _Text(path)
    if text.peek() != "[":
        require_list(read_json(path), what, path)
    text.take()
    if text.peek() == "]":
        require_list([], what, path)
    while True:
        yield text.value()
        separator = text.take()
        if separator == "]":
            break
        if separator != ",":
            _refuse(path, ValueError("Expecting ',' delimiter"))
    if text.peek():
        _refuse(path, ValueError("Extra data"))


class _Text:
    """A file's text from one place on, of which the largest entry is always at hand."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._decode = json.JSONDecoder().raw_decode
        self._pieces = _decode_pieces(path)
        self._text, self._at = "", 0

    def peek(self) -> str:
        """The next character that is not a space; empty at the end."""
        while True:
            while len(self._text) - self._at <= MAX_ENTRY_BYTES:
                if not (piece := next(self._pieces, "")):
                    break
                self._text, self._at = self._text[self._at :] + piece, 0
            self._at = _SPACES.match(self._text, self._at).end()  # type: ignore[union-attr]
            if self._at < len(self._text) or not self._text:
                return self._text[self._at : self._at + 1]
            self._text, self._at = "", 0

    def take(self) -> str:
        """The same, and go past it."""
        character = self.peek()
        self._at += 1
        return character

    def value(self) -> Any:
        """The value that begins here."""
        self.peek()
        try:
            value, end = self._decode(self._text, self._at)
        except (ValueError, RecursionError) as error:
            if len(self._text) - self._at > MAX_ENTRY_BYTES and not isinstance(
                error, RecursionError
            ):
                raise _too_large(self.path, "has an entry of", MAX_ENTRY_BYTES) from None
            _refuse(self.path, error)
        if end - self._at > MAX_ENTRY_BYTES:
            raise _too_large(self.path, "has an entry of", MAX_ENTRY_BYTES)
        self._at = end
        return value


def _decode_pieces(path: Path) -> Iterator[str]:
    try:
        yield from codecs.iterdecode(_pieces(path), "utf-8-sig")  # which gives no empty piece
    except UnicodeDecodeError as error:
        _refuse(path, error)


def _pieces(path: Path, limit: int | None = None) -> Iterator[bytes]:
    """A file's bytes, gunzipped where its name says so, and no more than `limit`."""
    require_file(path)
    try:
        zipped = path.suffix in (".jgz", ".gz")
        if zipped:
            expanded = GZIP_FLOOR_BYTES + GZIP_RATIO * path.stat().st_size
            limit = min(limit or expanded, expanded)
        length = 0
        with gzip.open(path) if zipped else path.open("rb") as file:
            while piece := file.read(_PIECE_BYTES):
                length += len(piece)
                if limit is not None and length > limit:
                    raise _too_large(path, "holds", limit)
                yield piece
    except gzip.BadGzipFile:
        raise InputError(f"{path}: is not a gzip file; download it again") from None
    except (EOFError, zlib.error):
        raise InputError(f"{path}: is a truncated or damaged gzip file; get it again") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error}); check the file") from None


def _too_large(path: Path, what: str, limit: int) -> InputError:
    return InputError(
        f"{path}: {what} more than {limit >> 10:,} KiB of text, which no real file of its kind "
        "does; get it again from a source you trust"
    )


def _refuse(path: Path, error: Exception) -> NoReturn:
    # Where in the file is not known any more, and no matter.
    reason = error.msg if isinstance(error, json.JSONDecodeError) else error
    raise InputError(f"{path}: is not valid JSON ({reason}); download it again") from None


def require_list(content: Any, what: str, file: Path) -> list[Any]:
    """`content`, if it is a list with something in it."""
    if not isinstance(content, list) or not content:
        raise InputError(
            f"{file}: expected {what} in a list, found {_kind(content)}; check the file"
        )
    return content


def require_dict(content: Any, what: str, file: Path) -> dict[str, Any]:
    """`content`, if it is a JSON object."""
    if not isinstance(content, dict):
        raise InputError(f"{file}: expected {what}, found {_kind(content)}; check the file")
    return content


def _kind(content: Any) -> str:
    return "an empty list" if content == [] else f"a {type(content).__name__}"
