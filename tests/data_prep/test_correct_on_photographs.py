"""What correction gains on real photographs whose depth is estimated.

`python -m pytest -s -m slow tests/data_prep/test_correct_on_photographs.py`
"""

from pathlib import Path

import numpy as np
import pytest

from data_prep import correct
from data_prep.correct import Correction, correct_pair
from extrap_train.config import Co3dConfig, FlowMatcherConfig, PrepConfig, StereoConfig
from extrap_train.data.store import PreparedData
from extrap_train.matching.build import matcher
from extrap_train.tasks.prepare import prepare_category

GATES = (0.0, 0.01, 0.02, 0.05)


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


def corrections(data: PreparedData) -> list[Correction]:
    method, found = matcher(FlowMatcherConfig()), []
    for pair in data.pairs("train"):
        (reference,), query = pair.references, pair.query
        images, depths, _ = data.frames(pair.sequence, [reference, query])
        cameras = data.cameras(pair.sequence)
        found.append(
            correct_pair(
                images[0],
                depths[0],
                cameras[reference],
                images[1],
                cameras[query],
                method,
                PrepConfig().correction_grid,
            )
        )
    return found


@pytest.mark.slow
def test_most_pairs_come_closer_and_none_gets_worse(
    apple: PreparedData, monkeypatch: pytest.MonkeyPatch
) -> None:
    default = correct.LEAST_GAIN
    monkeypatch.setattr(correct, "LEAST_GAIN", -1.0)
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
