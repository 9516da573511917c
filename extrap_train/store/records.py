"""Small JSON files that the project writes itself and reads back as dataclasses, field by field
checked: such a file may be damaged, or somebody else's by now.
"""

import dataclasses
import json
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from extrap_train.errors import InputError
from extrap_train.store.atomic import write_atomic

T = TypeVar("T")

MAX_RECORD_BYTES = 64 * 2**20


def write_record(path: Path, record: object) -> None:
    """Write a dataclass as indented JSON, atomically. NaN and infinities raise ValueError."""
    content = dataclasses.asdict(record)  # type: ignore[call-overload]
    write_atomic(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def read_record(path: Path, kind: type[T], remedy: str) -> T:
    """The record in a file that `write_record` wrote; entries that `kind` lacks are ignored.

    Raises InputError, which names the first entry that is missing or of the wrong type and ends
    with `remedy`, where the file is no such record: unreadable, damaged, nested without end, or
    larger than `MAX_RECORD_BYTES`.
    """
    try:
        if path.stat().st_size > MAX_RECORD_BYTES:
            raise InputError(f"{path}: is larger than any {kind.__name__} record; {remedy}")
        return TypeAdapter(kind).validate_json(path.read_bytes(), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        entry = ".".join(map(str, first["loc"])) or "the file"
        raise InputError(
            f"{path}: is no {kind.__name__} record ({entry}: {first['msg']}); {remedy}"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {remedy}") from None
