"""Scores of generated views: each is over the pixels that its name says."""

import math

import pytest
import torch

from extrap_train.diffusion.evaluation import missing_scores, score_images, summarise

_SIDE = 16
_LEFT = torch.arange(_SIDE).expand(1, _SIDE, _SIDE) < _SIDE // 2
_TOP = _LEFT.mT
_TRUTH = torch.full((1, 3, _SIDE, _SIDE), 0.4)
_OFF = 0.2  # 51 of 255: exact in eight bits


def _distance(made: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """In place of LPIPS, whose weights are not at hand everywhere."""
    return (made - truth).abs().mean((1, 2, 3))


def _scores(wrong: torch.Tensor, shown: torch.Tensor) -> dict[str, float]:
    """Of an image that is off in some pixels; references reach the left half."""
    made = _TRUTH + _OFF * wrong[:, None]
    table = score_images({"made": made}, _TRUTH, _LEFT.float(), shown.float(), ["v"], _distance)
    return summarise(table)["made"]


def test_errors_beside_the_object_do_not_count_against_it() -> None:
    scores = _scores(wrong=~_TOP, shown=_TOP)
    assert scores["psnr_object"] == scores["psnr_object_holes"] == 100
    assert scores["lpips_object"] == 0
    assert scores["psnr"] == pytest.approx(-10 * math.log10(_OFF**2 / 2), abs=1e-3)


def test_the_objects_holes_are_what_no_reference_reaches_of_it() -> None:
    scores = _scores(wrong=_TOP & ~_LEFT, shown=_TOP)
    assert scores["psnr_object_holes"] == pytest.approx(-20 * math.log10(_OFF), abs=1e-3)
    assert scores["psnr_object"] == pytest.approx(-10 * math.log10(_OFF**2 / 2), abs=1e-3)
    assert scores["psnr_warped"] == 100
    assert scores["lpips_object"] == pytest.approx(_OFF / 4, abs=1e-3)


def test_a_view_without_the_object_has_no_score_of_it() -> None:
    scores = _scores(wrong=_TOP, shown=torch.zeros_like(_TOP))
    assert all(math.isnan(scores[name]) for name in scores if "object" in name)
    assert math.isfinite(scores["psnr"])


def test_without_lpips_both_of_its_scores_are_missing_for_one_reason() -> None:
    assert missing_scores({"lpips": "no weights"}) == {
        "lpips": "no weights",
        "lpips_object": "no weights",
    }
    assert missing_scores({}) == {}
