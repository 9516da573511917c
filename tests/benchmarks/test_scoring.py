"""A cell's numbers, checked by hand and against other libraries."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio

from benchmarks.protocol.prepared_scene import TrueSurface, Truth
from benchmarks.score import scoring
from benchmarks.score.scoring import megascenes_compat, score_images, score_points
from extrap_train.config import ScoringConfig
from extrap_train.views import stack_cameras
from tests.benchmarks.analytic import view_at

_NO_NETWORKS = ScoringConfig(lpips=[], dists=False)


@pytest.fixture
def truth() -> Truth:
    views = [view_at(a, 32) for a in (0.0, 15.0)]
    masks = torch.zeros(2, 32, 32)
    masks[:, :8] = 1
    images = (torch.stack([v.image for v in views]) * 255).round() / 255
    return Truth(
        images=images,
        cameras=stack_cameras([v.camera for v in views]),
        warps=images * masks[:, None],
        masks=masks,
        depths=torch.stack([v.depth for v in views if v.depth is not None]),
        surface=None,
    )


def test_seen_and_unseen_pixels_are_apart(truth: Truth) -> None:
    """An error of 0.1 in the seen quarter and of 0.2 elsewhere: 20 dB, 14 dB, and between."""
    error = torch.where(truth.masks > 0, 0.1, 0.2)[:, None]
    images = torch.where(truth.images > 0.5, truth.images - error, truth.images + error)
    scores = score_images(images, truth, _NO_NETWORKS)
    assert scores["masked_psnr"].value == pytest.approx(20, abs=1e-4)
    assert scores["unseen_psnr"].value == pytest.approx(-20 * math.log10(0.2), abs=1e-4)
    mean = 0.25 * 0.1**2 + 0.75 * 0.2**2
    assert scores["psnr"].value == pytest.approx(-10 * math.log10(mean), abs=1e-4)
    assert scores["psnr"].per_image[0] == pytest.approx(
        peak_signal_noise_ratio(truth.images[0].numpy(), images[0].numpy(), data_range=1.0),
        abs=1e-4,
    )
    assert scores["coverage"].value == 0.25


def test_the_truth_itself_scores_perfectly(truth: Truth) -> None:
    scores = score_images(truth.images, truth, _NO_NETWORKS)
    for name in ("psnr", "masked_psnr", "unseen_psnr", "compat_psnr"):
        assert scores[name].value >= 100
    for name in ("ssim", "masked_ssim", "unseen_ssim", "compat_ssim"):
        assert scores[name].value == pytest.approx(1, abs=1e-6)
    assert scores["warp_psnr"] == scores["warp_psnr_truth"]


def test_an_empty_number_has_its_reason(truth: Truth) -> None:
    everything = replace(truth, masks=torch.ones_like(truth.masks), depths=None)
    scores = score_images(truth.images, everything, _NO_NETWORKS)
    assert scores["unseen_psnr"].value is None
    assert "every pixel" in scores["unseen_psnr"].reason
    assert scores["warp_psnr"].value is None
    assert "no true depth" in scores["warp_psnr"].reason


def test_megascenes_numbers_are_theirs(truth: Truth) -> None:
    """By hand: in [-1, 1], times the warped colours, over all pixels, pooled before the log."""
    images = (truth.images + 0.1).clamp(0, 1)
    scores = megascenes_compat(images, truth)
    difference = 2 * (images - truth.images) * truth.warps
    pooled = float(difference.square().mean())
    assert scores["compat_psnr"].value == pytest.approx(10 * math.log10(4 / pooled), abs=1e-4)
    masked = score_images(images, truth, _NO_NETWORKS)["masked_psnr"].value
    assert scores["compat_psnr"].value > masked + 5  # their definition flatters


def test_wrong_ranges_are_refused(truth: Truth) -> None:
    for images in (2 * truth.images - 1, 255 * truth.images):
        with pytest.raises(ValueError, match="images in"):
            score_images(images, truth, _NO_NETWORKS)


def test_a_missing_backbone_is_an_empty_number_and_never_another_net(
    truth: Truth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    scores = score_images(truth.images, truth, ScoringConfig(lpips=["alex", "vgg"]))
    for name in ("lpips_alex", "lpips_vgg", "dists"):
        assert scores[name].value is None
        assert "no weights" in scores[name].reason


def test_numbers_of_a_network_that_are_none_are_an_empty_number_with_its_reason(
    truth: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One image's alone is enough: a mean over the others would be another metric."""
    monkeypatch.setattr(
        scoring, "_lpips", lambda *_: lambda images, truth: torch.tensor([0.1, math.nan])
    )
    score = score_images(truth.images, truth, ScoringConfig(lpips=["alex"], dists=False))
    assert score["lpips_alex"].value is None
    assert "not finite" in score["lpips_alex"].reason


def test_lpips_is_named_by_its_net(truth: Truth, shared: Path) -> None:
    weights = {"squeeze": str(shared / "weights" / "lpips_squeeze.pt")}
    config = ScoringConfig(lpips=["squeeze"], lpips_weights=weights, dists=False)
    assert score_images(truth.images, truth, config)["lpips_squeeze"].value == 0


def test_points_are_scored_against_the_object_alone(truth: Truth) -> None:
    """A line of 101 points over a length of 1: the tolerance is 2 %, two points to each side."""
    line = torch.stack([torch.linspace(0, 1, 101), torch.zeros(101), torch.zeros(101)], 1)
    ground = torch.tensor([[0.5, 0.05, 0.0]])
    known = replace(truth, surface=TrueSurface(line, ground))
    made = torch.cat([line[:51], ground, torch.tensor([[0.5, -0.05, 0.0], [9.0, 9.0, 9.0]])])
    scores = {name: score.value for name, score in score_points(made, known).items()}
    assert scores["accuracy_share"] == pytest.approx(52 / 53)  # the far one is outside the box
    assert scores["completeness"] == pytest.approx(53 / 101)
    assert scores["accuracy_distance"] == pytest.approx(0.05 / 53)
    both = 52 / 53 + 53 / 101
    assert scores["f_score"] == pytest.approx(2 * 52 / 53 * 53 / 101 / both)


@pytest.mark.parametrize(("points", "said"), [(None, "no geometry"), (0, "surface is not known")])
def test_geometry_that_cannot_be_scored_says_why(
    truth: Truth, points: int | None, said: str
) -> None:
    scores = score_points(None if points is None else torch.zeros(3, 3), truth)
    assert len(scores) == 4
    assert all(s.value is None and said in s.reason for s in scores.values())
