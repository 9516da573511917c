"""A table's plan and cells as they are read: every entry is there and of its kind, or one line says
which is not. Results come from elsewhere, too: names in them lead to no other folder.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from benchmarks.cells import FAILED, OK, UNAVAILABLE
from extrap_train.config import TableConfig
from extrap_train.data.json_files import read_json
from extrap_train.errors import InputError

Kind = Callable[[Any], bool]
HASHES = (
    "protocol", "rules", "data", "device", "method", "code", "weights", "images", "scoring",
)  # fmt: skip


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_file_name(value: Any) -> bool:
    return isinstance(value, str) and Path(value).name == value and value not in ("", "..")


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    return isinstance(value, float) or _is_count(value)


def _or_none(kind: Kind) -> Kind:
    return lambda value: value is None or kind(value)


def _list_of(kind: Kind) -> Kind:
    return lambda value: isinstance(value, list) and all(map(kind, value))


def _mapping(key: Kind, kind: Kind) -> Kind:
    def fits(value: Any) -> bool:
        return isinstance(value, dict) and all(key(k) and kind(v) for k, v in value.items())

    return fits


def _record(kinds: Mapping[str, Kind]) -> Kind:
    return lambda value: (
        isinstance(value, dict)
        and all(name in value and kind(value[name]) for name, kind in kinds.items())
    )


def _anything(_value: Any) -> bool:
    return True


_OPTIONS = _mapping(_is_text, _anything)
_SCORE = _record(
    {
        "value": _or_none(_is_number),
        "reason": _is_text,
        "per_image": _list_of(_or_none(_is_number)),
    }
)
_CELL: Mapping[str, Kind] = {
    "key": _is_file_name,
    "method": _is_text,
    "options": _OPTIONS,
    "category": _is_text,
    "sequence": _is_text,
    "n_views": _is_count,
    "draw": _is_text,
    "seed": _is_count,
    "scene": _is_file_name,
    "device": _is_text,
    "status": lambda value: value in (OK, FAILED, UNAVAILABLE),
    "reason": _is_text,
    "hashes": _record(dict.fromkeys(HASHES, _is_text)),
}
_FINISHED: Mapping[str, Kind] = {
    "metrics": _mapping(_is_text, lambda value: _SCORE(value) and len(value) == 3),
    "images": _mapping(_is_file_name, _is_text),
    "points": _mapping(_is_file_name, _is_text),
    "seconds": _is_number,
    "wall_seconds": _is_number,
    "peak_memory_mib": _or_none(_is_number),
    "given": _OPTIONS,
    "counts": _OPTIONS,
}
_PLAN: Mapping[str, Kind] = {
    "table": _record({"name": _is_file_name}),
    "quick": lambda value: isinstance(value, bool),
    "protocol": _is_text,
    "methods": _mapping(_is_text, _record(dict.fromkeys(("title", "group", "time"), _is_text))),
    "cells": lambda value: _list_of(_is_file_name)(value) and len(set(value)) == len(value),
}


def read_record(folder: Path) -> dict[str, Any] | None:
    """A cell's record; None where there is none. Raises InputError where it, or a file that it
    names, is damaged.
    """
    file = folder / "cell.json"
    if not file.is_file():
        return None
    record = read_json(file)
    _require(record, _CELL, file, "record of this cell")
    if record["key"] != folder.name:
        raise InputError(f"{file}: is the record of the cell {record['key']}")
    if record["status"] == OK or {"images", "points"} & record.keys():
        _require(record, _FINISHED, file, "record of this cell")
    for name, stated in (record.get("images", {}) | record.get("points", {})).items():
        held = folder / name
        if not held.is_file() or hashlib.sha256(held.read_bytes()).hexdigest() != stated:
            raise InputError(f"{held}: is missing, or not what its cell's hash says")
    return cast(dict[str, Any], record)


def read_plan(file: Path) -> dict[str, Any]:
    """What a table was when it was last run; raises InputError where that is damaged."""
    plan = read_json(file)
    _require(plan, _PLAN, file, "table's plan")
    return {**plan, "table": asdict(table_of(plan, file))}


def table_of(plan: Mapping[str, Any], file: Path) -> TableConfig:
    """The table that a plan, read from `file`, was made of; options that it does not say yet have
    their defaults.
    """
    try:
        merged = OmegaConf.merge(OmegaConf.structured(TableConfig), plan["table"])
        return cast(TableConfig, OmegaConf.to_object(merged))
    except (OmegaConfBaseException, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{file}: is no table's plan ({reason}); run the table again") from None


def planned_cells(folder: Path, plan: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The records of a plan's cells, without those that are missing.

    Raises InputError where one is damaged, of another protocol or of no row.
    """
    cells = []
    for key in plan["cells"]:
        cell = read_record(folder / key)
        if cell is None:
            continue
        of, planned = cell["hashes"]["protocol"], plan["protocol"]
        if of != planned:
            raise InputError(
                f"{folder / key}: is a result of another protocol ({of[:12]}, the table's is "
                f"{planned[:12]}); remove it"
            )
        if cell["method"] not in plan["methods"]:
            raise InputError(
                f"{folder / key}: is of {cell['method']}, and the table has no such row; remove it"
            )
        cells.append(cell)
    return cells


def _require(content: Any, kinds: Mapping[str, Kind], file: Path, what: str) -> None:
    entries = content if isinstance(content, dict) else {}
    for name, kind in kinds.items():
        if name not in entries or not kind(entries[name]):
            raise InputError(f"{file}: is no {what} ({name} is missing or damaged in it)")
