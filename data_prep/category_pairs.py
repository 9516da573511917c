"""From a category's name to prepared pairs: synthesis where the data is synthetic, then reading and
preparation.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from data_prep.model_cache import PrepModels
from data_prep.preparation import prepare
from data_prep.sequence_job import pair_options
from data_prep.synthesize import synthesize
from extrap_train.config import (
    Co3dConfig,
    DataConfig,
    DataPrepConfig,
    DatasetDepthConfig,
    DepthConfig,
    DownloadConfig,
    FoldersConfig,
    LauncherConfig,
    LocalConfig,
    MatcherConfig,
    PrepConfig,
    SyntheticConfig,
    TrainConfig,
    Uco3dConfig,
    resolve_paths,
)
from extrap_train.data import capture_folders, co3d, uco3d
from extrap_train.data.co3d.annotations import read_sequence_split
from extrap_train.data.prepared import PreparedData
from extrap_train.data.sequences import FrameSequence
from extrap_train.data.shards import open_shards
from extrap_train.errors import InputError
from extrap_train.jobs import Launcher
from extrap_train.jobs.launchers import open_launcher
from extrap_train.store.digests import json_digest

LOCAL = LocalConfig()
_REQUIRE = {
    Co3dConfig: co3d.require_category,
    Uco3dConfig: uco3d.require_category,
    FoldersConfig: capture_folders.require_category,
}
"""What refuses a category that is not there, cheaply."""


def prepare_category(
    category: str,
    data: DataConfig,
    depth: DepthConfig,
    prep: PrepConfig,
    *,
    output: Path,
    workers: int | None,
    matcher: MatcherConfig,
    poses: MatcherConfig | None = None,
    launcher: LauncherConfig = LOCAL,
    retry: bool = False,
) -> PreparedData:
    """Sequences of one category as pairs on disk; what is there already is used again.

    `poses` says whose matches place photographs that have no cameras, by default SIFT's. `workers`
    are local processes, by default `PrepModels.default_workers`. With `retry`, sequences that
    failed before are tried again. Paths are followed to where they lead, so that other spellings
    of one are the same preparation.
    """
    data, depth, matcher = resolve_paths(data), resolve_paths(depth), resolve_paths(matcher)
    how = matcher if is_corrected(data, depth, prep) else None
    models = PrepModels(depth, how)
    models.check()  # before anything is rendered
    workers = workers or models.default_workers()
    correction = asdict(how) if how else None
    frames_of = [category, _source(data), asdict(depth), prep.image_size]
    pairs_of = [*frames_of, pair_options(prep), correction]
    all_of = [category, asdict(data), asdict(depth), asdict(prep), correction]
    frames, pairs, folder = (
        output / kind / f"{category}-{json_digest(made_of)[:8]}"
        for kind, made_of in (("frames", frames_of), ("pairs", pairs_of), ("data", all_of))
    )
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (
        _alone(folder.parent / f".{category}.lock"),
        open_launcher(launcher, workers, folder.parent / "slurm") as opened,
    ):
        sequences, test_names = _sequences(category, data, depth, poses, output, opened)
        return prepare(
            sequences,
            depth,
            prep,
            test_names=test_names,
            folder=folder,
            frames=frames,
            pairs=pairs,
            matcher=how,
            launcher=opened,
            retry=retry,
            source=asdict(data),
        )


def prepare_members(
    config: TrainConfig | DataPrepConfig,
    *,
    workers: int | None,
    launcher: LauncherConfig = LOCAL,
    retry: bool = False,
) -> Iterator[PreparedData]:
    """The pairs of every member of the category, one after another, prepared now or before.

    InputError where a member is not there, before minutes go into those ahead of it.
    """
    members, data = config.category.members, config.data
    if isinstance(data, DownloadConfig) and data.root is not None:
        for member in members:
            _REQUIRE[type(data)](Path(data.root), member)
    for member in members:
        yield prepare_category(
            member,
            data,
            config.depth,
            config.prep,
            output=Path(config.output),
            workers=workers,
            matcher=config.matcher,
            poses=config.poses,
            launcher=launcher,
            retry=retry,
        )


def prepare_for_training(config: TrainConfig) -> list[PreparedData]:
    """The pairs that a training needs; sequences that failed before are not tried again."""
    if config.shards is not None:
        return [*_open_members(config, config.shards)]
    return [*prepare_members(config, workers=config.threads)]


def _open_members(config: TrainConfig, shards: str) -> Iterator[PreparedData]:
    """The pairs of every member from shards; InputError where they were made with other options."""
    data, depth = resolve_paths(config.data), resolve_paths(config.depth)
    how = resolve_paths(config.matcher) if is_corrected(data, depth, config.prep) else None
    asked = _named(asdict(data), asdict(config.prep), repr(depth), repr(how) if how else None)
    for member in config.category.members:
        opened = open_shards(shards, member, Path(config.output) / "shards")
        made = opened.manifest
        found = _named(made["data"] or {}, made["options"], made["depth"], made["correction"])
        for name, value in asked.items():
            if found.get(name) != value:
                raise InputError(
                    f"shards={shards}: {member} was prepared with {name}={found.get(name)} and not "
                    f"{value}; give the same, or prepare it again"
                )
        yield opened


def _named(
    data: dict[str, Any], prep: dict[str, Any], depth: str, matcher: str | None
) -> dict[str, Any]:
    """Options by their names, as JSON gives them; the captures may lie elsewhere by now."""
    named = {f"data.{name}": value for name, value in data.items() if name != "root"}
    named |= {f"prep.{name}": value for name, value in prep.items()}
    options: dict[str, Any] = json.loads(json.dumps(named | {"depth": depth, "matcher": matcher}))
    return options


def is_corrected(data: DataConfig, depth: DepthConfig, prep: PrepConfig) -> bool:
    """Whether training warps are corrected: as asked, else wherever depth is not exact."""
    if prep.correct is not None:
        return prep.correct
    return not (isinstance(data, SyntheticConfig) and isinstance(depth, DatasetDepthConfig))


@contextmanager
def _alone(lock: Path) -> Iterator[None]:
    """The jobs of a sweep share their data: the first one makes it, the others wait and say so."""
    try:
        held = FileLock(lock).acquire(timeout=0)
    except Timeout:
        print(f"{lock.parent}: another process prepares this category; waiting for it")
        held = FileLock(lock).acquire()
    with held:
        yield


def _sequences(
    category: str,
    data: DataConfig,
    depth: DepthConfig,
    poses: MatcherConfig | None,
    output: Path,
    launcher: Launcher,
) -> tuple[list[FrameSequence], set[str] | int]:
    if isinstance(data, SyntheticConfig):
        root = Path(data.root) if data.root else output / "synthetic"
        synthesize(data, category, root, launcher)
        wanted = {f"{i:04d}" for i in range(data.test_sequences + data.train_sequences)}
        sequences = [s for s in co3d.read_category(root, category) if s.name in wanted]
        return sequences, {f"{i:04d}" for i in range(data.test_sequences)}
    assert data.root is not None
    root = Path(data.root)
    if isinstance(data, Uco3dConfig):
        return uco3d.read_category(root, category), data.test_sequences
    if isinstance(data, FoldersConfig):
        needs_depth = isinstance(depth, DatasetDepthConfig)
        captures = capture_folders.read_category(root, category, poses, needs_depth=needs_depth)
        return captures, data.test_sequences
    assert isinstance(data, Co3dConfig)
    sequences = co3d.read_category(root, category)
    if data.set_list is None:
        return sequences, data.test_sequences
    train, test = read_sequence_split(root, category, data.set_list)
    return [s for s in sequences if s.name in train | test], set(test)


def _source(data: DataConfig) -> dict[str, Any]:
    """What a photograph depends on: not on which sequences are for what."""
    split = ("test_sequences", "train_sequences", "set_list")
    return {name: value for name, value in asdict(data).items() if name not in split}
