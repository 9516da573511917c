"""Weights that appear, or change, are asked; the images that they judge are not made again."""

import hashlib
import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import lpips
import pytest
import torch
from torchvision.models import (
    AlexNet_Weights,
    SqueezeNet1_1_Weights,
    VGG16_Weights,
    squeezenet1_1,
)

from benchmarks.__main__ import main
from benchmarks.report.aggregate import read_results
from benchmarks.report.verify import Verification, verify
from benchmarks.run.identity import judging_files
from benchmarks.score import scoring
from extrap_train.config import LPIPS_NETS, ScoringConfig
from extrap_train.errors import InputError
from extrap_train.metrics import BACKBONES, dists_distance, lpips_distance
from tests.benchmarks.tables import greys_folder, run_greys

_ONE_ROW = ("methods=[dark]", "scoring.lpips=[squeeze]")


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty hub cache, and networks as a new process finds them."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    (cache := tmp_path / "torch" / "hub" / "checkpoints").mkdir(parents=True)
    scoring._lpips.cache_clear()
    yield cache
    scoring._lpips.cache_clear()


@pytest.fixture
def put_backbone(hub: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Random weights under the name that promises them."""

    def put(seed: int) -> None:
        torch.manual_seed(seed)
        buffer = io.BytesIO()
        torch.save(squeezenet1_1(weights=None).state_dict(), buffer)
        digest = hashlib.sha256(buffer.getvalue()).hexdigest()
        monkeypatch.setitem(BACKBONES, "squeeze", f"squeezenet1_1-{digest[:8]}.pth")
        (hub / BACKBONES["squeeze"]).write_bytes(buffer.getvalue())
        scoring._lpips.cache_clear()

    return put


def _scored(own: Path, output: Path) -> dict[str, tuple[float | None, float]]:
    assert run_greys(own, output, *_ONE_ROW, quick=True) == 0
    cells = read_results(greys_folder(output)).cells
    return {c.method: (c.metrics["lpips_squeeze"].value, c.seconds) for c in cells}


def test_a_backbone_put_into_the_hub_cache_is_used_by_the_next_run(
    own: Path,
    put_backbone: Callable[[int], None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = _scored(own, tmp_path)
    run_greys(own, tmp_path, *_ONE_ROW, quick=True, dry_run=True)
    said = " ".join(capsys.readouterr().out.split())
    assert "lpips_squeeze stays empty: LPIPS (squeeze) has no weights" in said
    put_backbone(0)
    first = _scored(own, tmp_path)
    assert "0 reused, 1 open" in capsys.readouterr().out
    run_greys(own, tmp_path, *_ONE_ROW, quick=True, dry_run=True)
    said = capsys.readouterr().out
    assert "1 reused, 0 open" in said
    assert "stays empty" not in said
    put_backbone(1)
    second = _scored(own, tmp_path)
    for method, (value, seconds) in before.items():
        assert value is None
        assert first[method][0] is not None
        assert second[method][0] not in (None, first[method][0])
        assert seconds == first[method][1] == second[method][1]  # not made again


def test_the_files_are_those_that_the_metrics_ask_for(hub: Path) -> None:
    """And torchvision's own, by the addresses that it downloads them from."""
    with pytest.raises(InputError, match=BACKBONES["vgg"]):
        dists_distance()
    for net in LPIPS_NETS:
        with pytest.raises(InputError, match=BACKBONES[net]):
            lpips_distance(net, None, "option")
    published = (AlexNet_Weights.DEFAULT, VGG16_Weights.DEFAULT, SqueezeNet1_1_Weights.DEFAULT)
    names = [weights.url.rpartition("/")[2] for weights in published]
    assert [BACKBONES[net] for net in ("alex", "vgg", "squeeze")] == names


def test_a_named_file_stands_before_the_cached_one(hub: Path) -> None:
    for name in ("squeezenet1_1-b8a52dc0.pth", "vgg16-397923af.pth", "alexnet-owt-7be5be79.pth"):
        (hub / name).touch()
    config = ScoringConfig(lpips=["squeeze", "vgg"], lpips_weights={"vgg": "own.pt"})
    assert judging_files(config) == {
        "lpips_vgg": Path("own.pt"),
        "lpips_squeeze": hub / "squeezenet1_1-b8a52dc0.pth",
        "dists": hub / "vgg16-397923af.pth",
    }


def test_verification_judges_with_the_very_weights_or_says_that_it_did_not(
    own: Path,
    put_backbone: Callable[[int], None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    weights = tmp_path / "lpips.pt"
    torch.save(lpips.LPIPS(net="squeeze", pnet_rand=True, verbose=False).state_dict(), weights)
    words = [*_ONE_ROW, f"scoring.lpips_weights.squeeze={weights}"]
    assert run_greys(own, tmp_path, *words, quick=True) == 0
    folder = greys_folder(tmp_path)
    assert verify(folder) == Verification(cells=1)
    moved = weights.rename(tmp_path / "elsewhere.pt")
    here = {"lpips_squeeze": "its weights are not here; give scoring.lpips_weights.squeeze=FILE"}
    assert verify(folder) == Verification(cells=1, unchecked=here)
    assert verify(folder, {"squeeze": str(moved)}) == Verification(cells=1)
    put_backbone(0)
    assert "not those" in verify(folder).unchecked["lpips_squeeze"]
    capsys.readouterr()
    assert main(["verify", str(folder.path)]) == 0
    said = capsys.readouterr()
    assert "every metric but lpips_squeeze follows from the saved images" in said.out
    assert "lpips_squeeze: not checked: the weights here are not those" in said.err
    option = f"scoring.lpips_weights.squeeze={moved}"
    file = next(folder.cells.glob("*/cell.json"))
    record = json.loads(file.read_text())
    record["metrics"]["lpips_squeeze"]["value"] += 0.1
    file.write_text(json.dumps(record))
    assert main(["verify", str(folder.path), option]) == 1
    assert "lpips_squeeze is stated as" in capsys.readouterr().err
    assert main(["verify", str(folder.path), "rules.pool=9"]) == 1
    assert "scoring.lpips_weights.NET=FILE" in capsys.readouterr().err
