"""Captures prepared as a download's are."""

from collections.abc import Sequence as Some
from pathlib import Path

from data_prep.preparation import prepare
from extrap_train.config import PrepConfig
from extrap_train.data.prepared import PreparedData
from extrap_train.data.sequences import FrameSequence
from extrap_train.depth import DatasetDepth


def prepared_captures(
    folder: Path, captures: Some[FrameSequence], test_names: set[str]
) -> PreparedData:
    """Pairs of the captures at 16 pixels, as if they came from CO3D."""
    return prepare(
        list(captures),
        DatasetDepth(),
        PrepConfig(image_size=16),
        test_names=test_names,
        folder=folder,
        progress=False,
        source={"name": "co3d"},
    )
