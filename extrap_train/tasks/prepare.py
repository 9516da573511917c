"""From a category's name to prepared pairs: synthesis where the data is synthetic, then reading and
preparation.
"""

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

from filelock import FileLock

from data_prep.build import prepare
from data_prep.synthesize import synthesize
from extrap_train.config import (
    Co3dConfig,
    DataConfig,
    DepthConfig,
    LauncherConfig,
    LocalConfig,
    PrepConfig,
    SyntheticConfig,
)
from extrap_train.data.co3d import read_category
from extrap_train.data.sequences import Sequence
from extrap_train.data.store import PreparedData
from extrap_train.depth.build import depth_source
from extrap_train.jobs import Launcher
from extrap_train.jobs.build import open_launcher

LOCAL = LocalConfig()


def prepare_category(
    category: str,
    data: DataConfig,
    depth: DepthConfig,
    prep: PrepConfig,
    *,
    output: Path,
    workers: int,
    launcher: LauncherConfig = LOCAL,
) -> PreparedData:
    """Sequences of one category as pairs on disk; what is there already is used again."""
    folder = output / "data" / f"{category}-{_digest(category, data, depth, prep)}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    # The jobs of a sweep share their data: the first one makes it, the others wait.
    with (
        FileLock(folder.parent / f".{category}.lock"),
        open_launcher(launcher, workers, folder.parent / "slurm") as opened,
    ):
        sequences, test_names = _sequences(category, data, output, opened)
        return prepare(
            sequences,
            depth_source(depth),
            prep,
            test_names=test_names,
            folder=folder,
            workers=workers,
        )


def _sequences(
    category: str, data: DataConfig, output: Path, launcher: Launcher
) -> tuple[list[Sequence], set[str] | int]:
    if isinstance(data, SyntheticConfig):
        root = Path(data.root) if data.root else output / "synthetic"
        synthesize(data, category, root, launcher)
        wanted = {f"{i:04d}" for i in range(data.test_sequences + data.train_sequences)}
        sequences = [s for s in read_category(root, category) if s.name in wanted]
        return sequences, {f"{i:04d}" for i in range(data.test_sequences)}
    assert isinstance(data, Co3dConfig)
    assert data.root is not None
    return read_category(Path(data.root), category), data.test_sequences


def _digest(category: str, data: DataConfig, depth: DepthConfig, prep: PrepConfig) -> str:
    parts = [category, asdict(data), asdict(depth), asdict(prep)]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:8]
