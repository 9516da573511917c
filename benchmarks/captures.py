"""The test captures of a table, whatever they come from."""

import os
from dataclasses import replace
from pathlib import Path

from benchmarks.protocol import Draw, Protocol, draw_sequence
from data_prep.filter import judge_all
from data_prep.split import split_sequences
from data_prep.synthesize import sequence_name, synthesize
from extrap_train.config import CapturesConfig, PrepConfig, RulesConfig, SyntheticConfig
from extrap_train.data.co3d import read_category
from extrap_train.data.files import read_json
from extrap_train.data.photographs import CATEGORY as NO_CATEGORY
from extrap_train.data.posed import TRANSFORMS, read_transforms
from extrap_train.data.scene import open_scene
from extrap_train.data.sequences import Sequence
from extrap_train.data.validation import require_list
from extrap_train.errors import InputError
from extrap_train.views import stack_poses


def open_captures(config: CapturesConfig, categories: list[str], folder: Path) -> list[Sequence]:
    """The test captures of some categories; rendered ones are made under `folder` if missing."""
    match config.source:
        case "synthetic":
            return [s for c in categories for s in _synthetic(config, c, folder)]
        case "co3d":
            return [s for c in categories for s in _co3d(config, c)]
        case "reconfusion":
            return _reconfusion(config)
        case _:
            return [_named(spec, categories) for spec in config.scenes]


def freeze(config: CapturesConfig, rules: RulesConfig, captures: list[Sequence]) -> Protocol:
    """Draw inputs and targets for every capture."""
    if config.source == "reconfusion":
        draws = [d for capture in captures for d in _given_draws(config, capture, rules)]
    else:
        draws = [
            draw
            for capture in captures
            for draw in draw_sequence(
                capture.category,
                capture.name,
                [frame.name for frame in capture.frames],
                stack_poses([frame.camera for frame in capture.frames]),
                rules,
            )
        ]
    return Protocol(rules, tuple(draws))


def _synthetic(config: CapturesConfig, category: str, folder: Path) -> list[Sequence]:
    options = SyntheticConfig(
        test_sequences=config.sequences,
        train_sequences=0,
        frames=config.frames,
        image_size=config.render_size,
        seed=config.seed,
    )
    root = Path(config.root) if config.root else folder
    synthesize(options, category, root, len(os.sched_getaffinity(0)))
    wanted = {sequence_name(index) for index in range(config.sequences)}
    return [s for s in read_category(root, category) if s.name in wanted]


def _co3d(config: CapturesConfig, category: str) -> list[Sequence]:
    """The captures that training on the same download holds out."""
    if config.root is None:
        raise InputError("captures.source=co3d needs the download: give captures.root=FOLDER")
    sequences = {f"{s.category}/{s.name}": s for s in read_category(Path(config.root), category)}
    verdicts = judge_all(list(sequences.values()), PrepConfig())
    kept = [name for name, verdict in zip(sequences, verdicts, strict=True) if verdict.kept]
    if not kept:
        reasons = sorted({verdict.reason for verdict in verdicts})[:3]
        raise InputError(f"{config.root}/{category}: no usable capture ({'; '.join(reasons)})")
    split = split_sequences(kept, config.sequences)
    return [sequences[name] for name in (*split.test, *split.lone)]


def _reconfusion(config: CapturesConfig) -> list[Sequence]:
    """A folder a scene, as the split's authors hand it out; frames are counted in name order."""
    if config.root is None:
        raise InputError("captures.source=reconfusion needs its folder: give captures.root=FOLDER")
    folders = sorted(file.parent for file in Path(config.root).glob(f"*/{TRANSFORMS}"))
    if not folders:
        raise InputError(f"{config.root}: no folder in it has a {TRANSFORMS}; check captures.root")
    return [replace(_by_name(read_transforms(f)), category="co3d", name=f.name) for f in folders]


def _by_name(capture: Sequence) -> Sequence:
    return replace(capture, frames=tuple(sorted(capture.frames, key=lambda frame: frame.name)))


def _given_draws(config: CapturesConfig, capture: Sequence, rules: RulesConfig) -> list[Draw]:
    """The split files' own choice, `{"train_ids": [...], "test_ids": [...]}`."""
    draws = []
    for n_views in rules.views:
        file = Path(str(config.root)) / capture.name / f"train_test_split_{n_views}.json"
        content = read_json(file)
        try:
            inputs, targets = (
                tuple(capture.frames[int(i)].name for i in require_list(content[key], key, file))
                for key in ("train_ids", "test_ids")
            )
        except (KeyError, IndexError, TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"{file}: names no frames of {capture.name} ({error!r}); get it again"
            ) from None
        draws.append(Draw(capture.category, capture.name, n_views, "given", 0, inputs, targets))
    return draws


def _named(spec: str, categories: list[str]) -> Sequence:
    """A capture that does not know its category takes the table's, if that is only one."""
    capture = open_scene(spec)
    if capture.category == NO_CATEGORY and len(categories) == 1:
        return replace(capture, category=categories[0])
    return capture
