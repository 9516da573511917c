"""Weights that appear, or change, are asked; the images that they judge are not made again."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torchvision.models import squeezenet1_1

from benchmarks import scoring
from benchmarks.backbones import _DOWNLOADS, judging_files
from benchmarks.results import read_results
from extrap_train.config import LPIPS_NETS, ScoringConfig
from extrap_train.errors import InputError
from extrap_train.metrics import dists_distance, lpips_distance
from tests.benchmarks.tables import greys_folder, run_greys


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty hub cache, and networks as a new process finds them."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    (cache := tmp_path / "torch" / "hub" / "checkpoints").mkdir(parents=True)
    scoring._lpips.cache_clear()
    yield cache
    scoring._lpips.cache_clear()


def _put_backbone(hub: Path, seed: int) -> None:
    torch.manual_seed(seed)
    torch.save(squeezenet1_1(weights=None).state_dict(), hub / "squeezenet1_1-b8a52dc0.pth")
    scoring._lpips.cache_clear()


def _scored(own: Path, output: Path) -> dict[str, tuple[float | None, float]]:
    assert run_greys(own, output, "scoring.lpips=[squeeze]", quick=True) == 0
    cells = read_results(greys_folder(output)).cells
    return {c["method"]: (c["metrics"]["lpips_squeeze"]["value"], c["seconds"]) for c in cells}


def test_a_backbone_put_into_the_hub_cache_is_used_by_the_next_run(
    own: Path, hub: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = _scored(own, tmp_path)
    run_greys(own, tmp_path, "scoring.lpips=[squeeze]", quick=True, dry_run=True)
    said = " ".join(capsys.readouterr().out.split())
    assert "lpips_squeeze stays empty: LPIPS (squeeze) has no weights" in said
    _put_backbone(hub, seed=0)
    first = _scored(own, tmp_path)
    assert "0 finished and used again, 2 open" in capsys.readouterr().out
    run_greys(own, tmp_path, "scoring.lpips=[squeeze]", quick=True, dry_run=True)
    said = capsys.readouterr().out
    assert "2 finished and used again, 0 open" in said
    assert "stays empty" not in said
    _put_backbone(hub, seed=1)
    second = _scored(own, tmp_path)
    for method, (value, seconds) in before.items():
        assert value is None
        assert first[method][0] is not None
        assert second[method][0] not in (None, first[method][0])
        assert seconds == first[method][1] == second[method][1]  # not made again


def test_the_files_are_those_that_the_metrics_ask_for(hub: Path) -> None:
    with pytest.raises(InputError, match=Path(_DOWNLOADS["dists"].url).name):
        dists_distance()
    for net in LPIPS_NETS:
        with pytest.raises(InputError, match=Path(_DOWNLOADS[f"lpips_{net}"].url).name):
            lpips_distance(net, None, "option")
    assert set(_DOWNLOADS) == {*(f"lpips_{net}" for net in LPIPS_NETS), "dists"}


def test_a_named_file_stands_before_the_cached_one(hub: Path) -> None:
    for name in ("squeezenet1_1-b8a52dc0.pth", "vgg16-397923af.pth", "alexnet-owt-7be5be79.pth"):
        (hub / name).touch()
    config = ScoringConfig(lpips=["squeeze", "vgg"], lpips_weights={"vgg": "own.pt"})
    assert judging_files(config) == {
        "lpips_vgg": Path("own.pt"),
        "lpips_squeeze": hub / "squeezenet1_1-b8a52dc0.pth",
        "dists": hub / "vgg16-397923af.pth",
    }
