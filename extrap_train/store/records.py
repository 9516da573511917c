"""Small JSON files that the project writes itself and reads back as dataclasses, field by field
checked: such a file may be damaged, or somebody else's by now. YAML is read as plain data.
"""

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import TypeAdapter, ValidationError

from extrap_train.errors import InputError
from extrap_train.store.atomic import write_atomic

T = TypeVar("T")

MAX_RECORD_BYTES = 64 * 2**20


def write_record(path: Path, record: object) -> None:
    """Write a dataclass as indented JSON, atomically. NaN and infinities raise ValueError."""
    content = dataclasses.asdict(record)  # type: ignore[call-overload]
    write_atomic(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def write_summary(folder: Path, content: Mapping[str, Any]) -> None:
    """Write a result's `summary.json`, atomically; NaN, as of a mean over no view, becomes null."""
    text = json.dumps(_without_nan(content), indent=1) + "\n"
    write_atomic(folder / "summary.json", text.encode())


def _without_nan(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def read_record(path: Path, kind: type[T], remedy: str) -> T:
    """The record in a file that `write_record` wrote; entries that `kind` lacks are ignored.

    Raises InputError, which names the first entry that is missing or of the wrong type and ends
    with `remedy`, where the file is not such a record: unreadable, damaged, nested without end, or
    larger than `MAX_RECORD_BYTES`.
    """
    try:
        if path.stat().st_size > MAX_RECORD_BYTES:
            raise _too_large(str(path), remedy)
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {remedy}") from None
    return parse_record(content, str(path), kind, remedy)


def parse_record(content: bytes, where: str, kind: type[T], remedy: str) -> T:
    """The record in a file's content, as `read_record` reads it; errors say `where` it is."""
    if len(content) > MAX_RECORD_BYTES:
        raise _too_large(where, remedy)
    try:
        return TypeAdapter(kind).validate_json(content, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        entry = ".".join(map(str, first["loc"])) or "the file"
        raise InputError(f"{where}: damaged ({entry}: {first['msg']}); {remedy}") from None


def _too_large(where: str, remedy: str) -> InputError:
    return InputError(f"{where}: damaged (larger than such a file can be); {remedy}")


def read_yaml(path: Path, remedy: str) -> dict[str, Any]:
    """The mapping in a YAML file as plain values.

    Raises InputError, which ends with `remedy`, for anything else.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: unreadable ({reason}); {remedy}") from None
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise InputError(f"{path}: unreadable (no mapping of options); {remedy}")
    return content
