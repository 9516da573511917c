"""A cell's code hash follows everything of a method's own that its file imports."""

from pathlib import Path

import pytest

from benchmarks import fingerprint


def _fresh_hash(module: str) -> str:
    """As another process finds it: within one, sources do not change."""
    for cached in (fingerprint._source, fingerprint._imports):
        cached.cache_clear()
    return fingerprint.code_hash([module])


def test_a_neighbour_that_is_imported_by_its_place_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "own_package"
    (folder / "deeper").mkdir(parents=True)
    files = {
        "__init__.py": "",
        "method.py": "from .deeper import paint\nfrom . import settings\n",
        "settings.py": "LEVEL = 1\n",
        "unused.py": "LEVEL = 1\n",
        "deeper/__init__.py": "from .brush import paint\n",
        "deeper/brush.py": "from ..colours import RED\npaint = RED\n",
        "colours.py": "RED = 1\n",
    }
    for name, source in files.items():
        (folder / name).write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    before = _fresh_hash("own_package.method")
    for name in ("settings.py", "deeper/brush.py", "colours.py", "unused.py"):
        (folder / name).write_text(files[name] + "# changed\n")
        changed = _fresh_hash("own_package.method") != before
        assert changed == (name != "unused.py"), name
        (folder / name).write_text(files[name])


def test_images_do_not_hang_on_how_they_are_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    source = fingerprint._source

    def spied(module: str) -> Path | None:
        asked.append(module)
        return source(module)

    monkeypatch.setattr(fingerprint, "_source", spied)
    fingerprint.code_hash(["benchmarks.making"])
    assert "benchmarks.scenes" in asked
    assert not {"benchmarks.scoring", "benchmarks.consistency", "benchmarks.captures"} & {*asked}
