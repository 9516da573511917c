"""What a run starts from is compared with what it ends in only if both were measured alike."""

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pandas as pd
import pytest
import torch
from rich.console import Console

from extrap_train.config import ValidationConfig
from extrap_train.diffusion.training import CategoryTraining
from extrap_train.errors import InputError
from extrap_train.runs import RunFolder
from extrap_train.tasks import results
from extrap_train.tasks.results import keep_start_scores, write_results


def _scores(psnr: float, lpips: float) -> pd.DataFrame:
    rows = [
        {"psnr": value, "lpips": lpips, "method": method, "view": f"cup/a/{view}-0"}
        for method, value in (("model", psnr), ("nearest", 15.0))
        for view in (1, 2)
    ]
    return pd.DataFrame(rows)


def _summary(
    folder: Path, scores: pd.DataFrame, missing: dict[str, str], patch: pytest.MonkeyPatch
) -> dict[str, Any]:
    patch.setattr(results, "draw_views", lambda prediction, path: None)
    patch.setattr(results, "provenance", lambda config, data: {})
    measured = SimpleNamespace(
        config=SimpleNamespace(validation=ValidationConfig()),
        scores=lambda: scores,
        pictures=lambda: None,
        model=torch.nn.Linear(1, 1),
    )
    write_results(
        cast(CategoryTraining, measured), [], missing, {}, 1, RunFolder(folder), Console(quiet=True)
    )
    return cast(dict[str, Any], json.loads((folder / "summary.json").read_text()))


def test_start_and_end_stand_side_by_side(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep_start_scores(_scores(20.0, 0.5), RunFolder(tmp_path))
    summary = _summary(tmp_path, _scores(22.0, 0.5), {}, monkeypatch)
    psnr = {method: row["psnr"] for method, row in summary["validation"].items()}
    assert psnr == {"model": 22.0, "nearest": 15.0, "start": 20.0}
    assert not summary["missing"]


@pytest.mark.parametrize(("before", "now"), [(math.nan, 0.3), (0.3, math.nan), (0.3, 0.4)])
def test_a_run_finishes_whose_start_was_measured_with_another_lpips(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: float, now: float
) -> None:
    """LPIPS's weights may be given, changed or lost between two commands of a run."""
    keep_start_scores(_scores(20.0, before), RunFolder(tmp_path))
    missing = {"lpips": "no weights"} if math.isnan(now) else {}
    summary = _summary(tmp_path, _scores(22.0, now), missing, monkeypatch)
    assert set(summary["validation"]) == {"model", "nearest"}
    assert "start" in summary["missing"]


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"method,view,psnr\nmodel,a,much\n"])
def test_damaged_scores_of_the_start_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes
) -> None:
    (tmp_path / "start.csv").write_bytes(content)
    with pytest.raises(InputError, match=r"start\.csv"):
        _summary(tmp_path, _scores(22.0, 0.3), {}, monkeypatch)
