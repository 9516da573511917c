"""What the pages say in Python runs as it stands, and rests on the public interface alone."""

import ast
import importlib
from pathlib import Path

import pytest
from PIL import Image

import extrap_train

_ROOT = Path(__file__).parents[2]


def _blocks(page: str) -> list[str]:
    """The Python of a page."""
    parts = (_ROOT / page).read_text().split("```python\n")[1:]
    return [part.split("```")[0] for part in parts]


def _run(block: str) -> dict:
    names: dict = {}
    exec(block, names)
    return names


@pytest.fixture(autouse=True)
def _empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_every_public_name_is_there_and_comes_from_where_it_is_documented() -> None:
    page = (_ROOT / "docs/python/public.md").read_text()
    for name in extrap_train.__all__:
        found = getattr(extrap_train, name)
        assert found.__doc__, name
        home = extrap_train._HOMES[name]
        assert getattr(importlib.import_module(home), name) is found
        assert f"::: {home}.{name}" in page or f"::: {home}\n" in page or f"`{name}`" in page
    with pytest.raises(AttributeError, match="open_everything"):
        extrap_train.open_everything  # noqa: B018


def test_the_pages_import_public_names_only() -> None:
    pages = ["README.md", *(str(p.relative_to(_ROOT)) for p in (_ROOT / "docs").rglob("*.md"))]
    blocks = [(page, block) for page in pages for block in _blocks(page)]
    assert len(blocks) >= 5
    for page, block in blocks:
        for node in ast.walk(ast.parse(block)):
            modules = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                modules.append(node.module or "")
                if node.module == "extrap_train":
                    assert {alias.name for alias in node.names} <= set(extrap_train.__all__), page
            ours = {"extrap_train", "benchmarks", "data_prep"}
            private = [m for m in modules if m.split(".")[0] in ours and m != "extrap_train"]
            assert not private, page


def test_the_readmes_walk_and_method() -> None:
    walk, method = _blocks("README.md")
    made = _run(walk)
    assert made["images"].shape == (24, 3, 64, 64)
    assert made["generator"].precision == "auto"
    assert _run(method)["Average"]().weight_files("hydrant") == ()


def test_a_view_from_a_matrix_is_saved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = _run(_blocks("docs/scene.md")[0])
    assert Image.open(tmp_path / "further_back.png").size == (64, 64)
    assert "the inputs show" in capsys.readouterr().out
    assert made["made"].images.isfinite().all()


def test_a_warp_shows_the_same_as_the_generators() -> None:
    made = _run(_blocks("docs/python/public.md")[0])
    warp, views, cameras = made["warp"], made["views"], made["cameras"]
    assert warp.image.shape == (1, 3, 128, 128)
    assert 0.02 < float(warp.mask.mean()) < 1
    again = extrap_train.warp_view(views, cameras[2], size=64)
    assert float(again.mask.mean()) == pytest.approx(float(warp.mask.mean()), abs=0.05)
    itself = extrap_train.warp_view(views, views[0].camera)
    known = itself.mask[0] > 0
    assert (itself.image[0] - views[0].image)[:, known].abs().mean() < 0.02


@pytest.mark.slow
def test_depth_is_estimated() -> None:
    made = _run(_blocks("docs/scene.md")[1])
    assert len(made["views"]) == 8
    assert all((view.depth > 0).float().mean() > 0.1 for view in made["views"])


def test_a_scene_is_completed(tmp_path: Path) -> None:
    options = [
        "complete.generator=exact",
        "complete.exact_size=32",
        "complete.step_deg=120",
        "complete.dry_run=true",
        "data.image_size=32",
        f"output={tmp_path}",
    ]
    folder = extrap_train.complete_scene(
        "synthetic:hydrant/0003", "hydrant", inputs=3, options=options
    )
    assert folder == tmp_path / "complete/hydrant_0003"
    assert (folder / "plan.png").is_file()
    with pytest.raises(extrap_train.InputError, match="inputs"):
        extrap_train.complete_scene("synthetic:hydrant/0003", "hydrant", options=["inputs=x"])


@pytest.mark.slow
def test_a_method_is_scored(tmp_path: Path) -> None:
    options = [
        f"output={tmp_path}",
        "captures.frames=9",
        "captures.render_size=32",
        "rules.image_size=32",
        "rules.views=[3]",
        "scoring.lpips=[]",
        "scoring.dists=false",
    ]
    scores = extrap_train.score_method("inpainted", quick=True, options=options)
    assert set(scores["method"]) == {"inpainted"}
    psnr = scores[scores["metric"] == "psnr"]
    assert len(psnr) == 1
    assert 10 < float(psnr["mean"].iloc[0]) < 40
