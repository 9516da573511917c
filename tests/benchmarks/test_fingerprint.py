"""A cell's code hash follows everything of a method's own that its file imports."""

from pathlib import Path

import pytest

from benchmarks import fingerprint


def _fresh_hash(module: str) -> str:
    """As another process finds it: within one, sources do not change."""
    for cached in (fingerprint._source, fingerprint._imports, fingerprint._places):
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


def test_a_file_beside_the_method_counts_and_an_installed_one_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `--config-dir` gives it, with a virtual environment in the same folder."""
    installed = tmp_path / ".venv" / "lib" / "site-packages"
    files = {
        "own_blur.py": "import json\nimport own_library\nfrom own_helper import paint\n",
        "own_helper.py": "def paint():\n    from own_parts.deep import brush\n",
        "own_parts/deep/brush.py": "WIDTH = 1\n",  # no __init__.py on the way
        "own_rows/row.py": "import own_helper\n",
        "own_unused.py": "WIDTH = 1\n",
        ".venv/lib/site-packages/own_library.py": "WIDTH = 1\n",
    }
    for name, source in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(source)
    monkeypatch.syspath_prepend(installed)
    monkeypatch.syspath_prepend(tmp_path)
    counted = {
        "own_blur": {"own_blur.py", "own_helper.py", "own_parts/deep/brush.py"},
        "own_rows.row": {"own_rows/row.py", "own_helper.py", "own_parts/deep/brush.py"},
    }
    for method, expected in counted.items():
        before = _fresh_hash(method)
        for name, source in files.items():
            (tmp_path / name).write_text(source + "# changed\n")
            assert (_fresh_hash(method) != before) == (name in expected), (method, name)
            (tmp_path / name).write_text(source)
