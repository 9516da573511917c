"""What correction gains on real photographs whose depth is estimated.

`python -m pytest -s -m slow tests/data_prep/test_correct_on_photographs.py`
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional

from data_prep import correct
from data_prep.category_pairs import prepare_category
from data_prep.correct import Correction, correct_pair
from extrap_train.config import Co3dConfig, FlowMatcherConfig, PrepConfig, StereoConfig
from extrap_train.data.prepared import PreparedData
from extrap_train.matching.matchers import matcher
from extrap_train.views import View

GATES = (0.0, 0.01, 0.02, 0.05)
Picture = torch.Tensor


def upside_down(truth: Picture) -> Picture:
    return truth.flip(1)


def mirrored(truth: Picture) -> Picture:
    return truth.flip(2)


def shifted(truth: Picture) -> Picture:
    """As a wrong pose would."""
    return truth.roll((25, 25), (1, 2))


def smooth_noise(truth: Picture) -> Picture:
    coarse = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    return functional.interpolate(coarse, truth.shape[1:], mode="bicubic").clamp(0, 1)[0]


@pytest.fixture(scope="module")
def apple(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> PreparedData:
    return prepare_category(
        "apple",
        Co3dConfig(root=str(shared / "data" / "co3d")),
        StereoConfig(),
        PrepConfig(correct=False),
        output=tmp_path_factory.mktemp("apple"),
        workers=1,
        matcher=FlowMatcherConfig(),
    )


def corrections(
    data: PreparedData, truth: Callable[[Picture], Picture] = lambda image: image, every: int = 1
) -> list[Correction]:
    """Corrections of each `every`-th training pair, whose query photograph `truth` has changed."""
    method, found = matcher(FlowMatcherConfig()), []
    for pair in list(data.pairs("train"))[::every]:
        (reference,), query = pair.references, pair.query
        images = data.images(pair.sequence, [reference, query]).float() / 255
        depth = data.depths(pair.sequence, [reference])[0] * data.depth_unit(pair.sequence)
        cameras = data.cameras(pair.sequence)
        found.append(
            correct_pair(
                View(images[0], cameras[reference], depth.float()),
                View(truth(images[1]), cameras[query]),
                method,
                PrepConfig().correction_grid,
            )
        )
    return found


@pytest.mark.slow
def test_most_pairs_come_closer(apple: PreparedData, monkeypatch: pytest.MonkeyPatch) -> None:
    default = correct.MIN_GAIN
    monkeypatch.setattr(correct, "MIN_GAIN", -1.0)
    found = [c for c in corrections(apple) if c.flow is not None]
    gain = np.array([1 - c.error_after / c.error_before for c in found])
    pairs = len(apple.pairs("train"))
    print(f"\n{pairs} pairs, {len(found)} of them with a flow")
    print("least gain   moved   median gain")
    for gate in GATES:
        moved = gain[gain >= gate]
        print(f"{gate:10.0%} {len(moved):7} {np.median(moved):13.1%}")
    print(f"would be worse: {(gain < 0).sum()}")
    assert (gain >= default).sum() >= 0.8 * pairs


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [upside_down, mirrored, smooth_noise, shifted])
def test_a_wrong_truth_corrects_hardly_any_pair(
    apple: PreparedData, wrong: Callable[[Picture], Picture], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the gate is for: without it, as many pairs come closer to a wrong truth."""
    found = corrections(apple, wrong, every=2)
    monkeypatch.setattr(correct, "MAX_ACROSS", np.inf)
    ungated = [c for c in corrections(apple, wrong, every=2) if c.flow is not None]
    moved = sum(c.flow is not None for c in found)
    gain = np.median([1 - c.error_after / c.error_before for c in ungated])
    print(f"\n{wrong.__name__}: {moved} of {len(found)} move; wherever their matches lie,", end=" ")
    print(f"{len(ungated)} would, by {gain:.1%} in the median")
    assert moved <= 0.1 * len(found)
    assert len(ungated) >= 0.5 * len(found)
