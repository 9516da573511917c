"""What the pages say in Python runs as it stands."""

from pathlib import Path

import pytest
from PIL import Image

_ROOT = Path(__file__).parents[2]


def _blocks(page: str) -> list[str]:
    """The Python of a page that paints views."""
    parts = (_ROOT / page).read_text().split("```python\n")[1:]
    blocks = [part.split("```")[0] for part in parts]
    return [block for block in blocks if "open_generator" in block]


def _run(block: str) -> dict:
    names: dict = {}
    exec(block, names)
    return names


def test_the_readmes_walk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (block,) = _blocks("README.md")
    made = _run(block)
    assert made["images"].shape == (24, 3, 64, 64)
    assert made["generator"].precision == "bf16-mixed"


def test_a_view_from_a_matrix_is_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    made = _run(_blocks("docs/scene.md")[0])
    assert Image.open(tmp_path / "further_back.png").size == (64, 64)
    assert "the inputs show" in capsys.readouterr().out
    assert made["made"].images.isfinite().all()


@pytest.mark.slow
def test_depth_is_estimated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made = _run(_blocks("docs/scene.md")[1])
    assert len(made["views"]) == 8
    assert all((view.depth > 0).float().mean() > 0.1 for view in made["views"])
