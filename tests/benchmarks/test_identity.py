"""A cell is reused only with the same code: what is hashed, and what is not."""

from pathlib import Path

import pytest

from benchmarks.run.identity import _MAKING, _ROOT, _SCORING, _sources, sources_digest


def _digest(module: str) -> str:
    """As another process finds it: within one, sources do not change."""
    sources_digest.cache_clear()
    return sources_digest((), module)


def test_a_file_beside_the_method_counts_and_an_installed_one_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `--config-dir` gives it, with a virtual environment in the same folder."""
    files = {
        "own_blur.py": True,
        "own_helper.py": True,
        "own_parts/deep/brush.py": True,  # no __init__.py on the way
        "own_rows/row.py": True,
        "own_rows/notes.txt": False,
        ".venv/lib/own_library.py": False,
        "env/lib/site-packages/own_library.py": False,
    }
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("WIDTH = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    for module in ("own_blur", "own_rows.row"):
        before = _digest(module)
        for name, counts in files.items():
            (tmp_path / name).write_text("WIDTH = 2\n")
            assert (_digest(module) != before) == counts, (module, name)
            (tmp_path / name).write_text("WIDTH = 1\n")
        assert _digest(module) == before


def test_an_installed_method_is_its_own_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed = tmp_path / "site-packages"
    installed.mkdir()
    for name in ("installed_method.py", "another.py"):
        (installed / name).write_text("WIDTH = 1\n")
    monkeypatch.syspath_prepend(installed)
    before = _digest("installed_method")
    (installed / "another.py").write_text("WIDTH = 2\n")
    assert _digest("installed_method") == before
    (installed / "installed_method.py").write_text("WIDTH = 2\n")
    assert _digest("installed_method") != before


def test_images_do_not_depend_on_how_they_are_scored_or_reported() -> None:
    making, scoring = (
        {file.relative_to(_ROOT).as_posix() for place in places for file in _sources(_ROOT / place)}
        for places in (_MAKING, _SCORING)
    )
    assert {"benchmarks/methods/diffusion.py", "extrap_train/diffusion/sampler.py"} <= making
    assert {"benchmarks/score/scoring.py", "extrap_train/metrics.py"} <= scoring
    assert not any(name.startswith(("benchmarks/score", "benchmarks/report")) for name in making)
    assert not any(name.startswith(("benchmarks/report", "benchmarks/run")) for name in scoring)
    assert all((_ROOT / place).exists() for place in (*_MAKING, *_SCORING))
