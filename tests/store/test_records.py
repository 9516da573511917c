"""A record comes back as it was written, and every kind of damage is one line."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from extrap_train.errors import InputError
from extrap_train.store.records import read_record, read_yaml, write_record


@dataclass(frozen=True)
class _Camera:
    name: str
    size: tuple[int, int]


@dataclass(frozen=True)
class _Scene:
    title: str
    scale: float
    cameras: dict[str, _Camera]
    seed: int | None = None


_SCENE = _Scene("a — b", 1.5, {"left": _Camera("l", (3, 4))})


def test_a_record_comes_back_as_it_was_written(tmp_path: Path) -> None:
    write_record(tmp_path / "scene.json", _SCENE)
    assert read_record(tmp_path / "scene.json", _Scene, "make it again") == _SCENE


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b"\xff\xfe",
        b'{"title": "t"}',
        b'{"title": 3, "scale": 1.0, "cameras": {}}',
        b'{"title": "t", "scale": "1.0", "cameras": {}}',
        b'{"title": "t", "scale": 1.0, "cameras": {"l": {"name": "l", "size": [1]}}}',
        b'{"title": "t", "scale": 1.0, "cameras": {}, "seed": true}',
        b"[" * 100_000,
        b'{"title": ' * 100_000,
    ],
)
def test_damage_is_one_line_that_names_the_file(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "scene.json"
    file.write_bytes(content)
    with pytest.raises(InputError) as error:
        read_record(file, _Scene, "make it again")
    message = str(error.value)
    assert str(file) in message
    assert message.endswith("make it again")
    assert "\n" not in message


def test_a_missing_file_or_a_folder_is_one_line(tmp_path: Path) -> None:
    for file in (tmp_path / "absent.json", tmp_path):
        with pytest.raises(InputError, match="make it again"):
            read_record(file, _Scene, "make it again")


def test_numbers_that_json_has_not_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        write_record(tmp_path / "scene.json", _Scene("t", float("nan"), {}))
    assert not (tmp_path / "scene.json").exists()


@pytest.mark.parametrize(
    "content",
    [
        "[" * 20_000,
        "a: " + "{b: " * 5_000,
        "a: !!python/object/apply:os.system [ls]\n",
        "- a\n",
        "3: x\n",
        "a: [",
        "\x00",
        "",
    ],
)
def test_yaml_that_is_more_than_plain_options_is_one_line(tmp_path: Path, content: str) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(content)
    with pytest.raises(InputError, match=r"config\.yaml: unreadable .*; remove it"):
        read_yaml(file, "remove it")


def test_yaml_resolves_nothing(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("a: ${oc.env:HOME}\nb: {c: [1, null]}\n")
    assert read_yaml(file, "") == {"a": "${oc.env:HOME}", "b": {"c": [1, None]}}
