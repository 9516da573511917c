"""The test captures of a table, whatever they come from; none that a model was trained on."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
from pydantic import Field

from benchmarks.protocol.array_files import read_points
from benchmarks.protocol.draws import Draw, Protocol, draw_sequence
from benchmarks.protocol.prepared_scene import TrueSurface
from data_prep.filter import judge_all
from data_prep.split import by_hash, split_sequences
from extrap_train.config import (
    CapturesConfig,
    MethodConfig,
    PrepConfig,
    RulesConfig,
    SyntheticConfig,
)
from extrap_train.data import capture_folders, co3d
from extrap_train.data.scene_spec import (
    CO3D_SCHEME,
    SYNTHETIC_SCHEME,
    UCO3D_SCHEME,
    open_scene,
)
from extrap_train.data.sequences import NO_CATEGORY, FrameSequence
from extrap_train.data.synthetic import DENSE_POINTS, build_scene, surface_points
from extrap_train.data.synthetic.capture import synthetic_sequence
from extrap_train.data.transforms_json import TRANSFORMS, read_transforms
from extrap_train.diffusion.hub import is_repository, weights_folder
from extrap_train.diffusion.leakage import (
    TrainedCaptures,
    UnrecordedCaptures,
    trainings_of,
    unrecorded_models,
)
from extrap_train.errors import InputError
from extrap_train.store.manifest import MANIFEST, Split
from extrap_train.store.records import read_record
from extrap_train.views import stack_poses


@dataclass(frozen=True)
class Capture:
    """A test capture, and its true surface where that is known."""

    sequence: FrameSequence
    surface: Callable[[], TrueSurface] | None = None


@dataclass(frozen=True)
class UsedTraining:
    """What a method's weights, or those that they started from, were trained on."""

    method: str
    option: str | None
    """Names the weights; None where the method may use any packaged model."""
    captures: TrainedCaptures
    is_of_weights: bool
    """Whether of the weights themselves."""

    def require_unseen(self, category: str, held_out: Split) -> None:
        """InputError for a capture that the model was trained on, or may have been."""
        if not (leaks := self.captures.find_leaks(category, held_out)):
            return
        model, capture = self.captures.model, f"{category}/{leaks[0]}"
        named = f"{self.option}: " if self.option else f"{self.method} may use packaged models: "
        said = f"{model} was trained on the capture {capture}"
        if isinstance(self.captures, UnrecordedCaptures):
            said = f"no {MANIFEST} says that {model} was not trained on the capture {capture}"
        others = " or other weights" if self.option else ""
        raise InputError(
            f"{named}{said}; give captures that it has not seen (captures.sequences, "
            f"captures.seed, captures.scenes){others}"
        )


Trained = Sequence[UsedTraining]


def trained_models(methods: Iterable[MethodConfig], categories: Collection[str]) -> Trained:
    """What the methods' models were trained on, as far as that is known.

    A method that names no `weights` may use any packaged model; those have one training. Weights
    that cannot be downloaded are left out: the method is unavailable with them, and says why.
    """
    found = []
    for method in methods:
        named = method.options.get("weights")
        option = f"options.{method.name}.weights"
        for weights in sorted(
            {str(named or "base").replace("{category}", c) for c in categories or [""]}
        ):
            if is_repository(weights) and not _is_there(weights, option):
                continue
            trainings = [*trainings_of(weights, option)]
            trainings += [
                UnrecordedCaptures(model, "", Split("", (), ()))
                for model in unrecorded_models(weights, option)
            ]
            found += [
                UsedTraining(method.name, option if named else None, t, t.model == weights)
                for t in trainings
            ]
    return found


def _is_there(repository: str, option: str) -> bool:
    try:
        weights_folder(repository, option)
    except InputError:
        return False
    return True


def _held_out_by_all(
    trained: Trained, source: str, category: str, present: Collection[str], count: int
) -> list[str] | None:
    """Up to `count` test captures that every model of a source's category holds out, in the order
    of a split; None where there is no model of it. Raises InputError where there are none.
    """
    known = [(t.captures, t.is_of_weights) for t in trained if t.captures.category == category]
    known = [(captures, is_used) for captures, is_used in known if captures.split.source == source]
    tested = [captures.split.test for captures, is_used in known if is_used]
    if not tested:
        return None
    seen = [captures.split.train for captures, _ in known]
    common = set(present).intersection(*tested).difference(*seen)
    if not common:
        runs = " and ".join(sorted({captures.model for captures, _ in known}))
        raise InputError(
            f"{category}: none of the {len(present)} captures is held out by {runs}; test on "
            "other captures, or train with more data.test_sequences"
        )
    return sorted(sorted(common, key=lambda name: by_hash(f"{category}/{name}"))[:count])


def open_captures(
    config: CapturesConfig, categories: list[str], trained: Trained = ()
) -> list[Capture]:
    """The test captures of some categories; nothing is rendered or decoded yet.

    Raises InputError where there are none, and for one that a model was `trained` on.
    """
    captures = _open(config, categories, trained)
    if not captures:
        option = "captures.scenes" if config.source == "scenes" else "captures.categories"
        raise InputError(f"{option}=[]: the table has no captures; name at least one")
    for index, capture in enumerate(captures):
        sequence = capture.sequence
        held_out = _held_out(config, index, sequence.name)
        for training in trained:
            training.require_unseen(sequence.category, held_out)
    return captures


def _held_out(config: CapturesConfig, index: int, name: str) -> Split:
    """One of a table's captures as the split that holds it out."""
    if config.source == "synthetic":
        return Split("synthetic", (), (name,), config.seed)
    if config.source != "scenes":
        return Split("folders" if config.source == "folders" else "co3d", (), (name,))
    spec = config.scenes[index]
    if spec.startswith(SYNTHETIC_SCHEME):
        return Split("synthetic", (), (name,), SyntheticConfig().seed)
    scheme = next((s for s in (CO3D_SCHEME, UCO3D_SCHEME) if spec.startswith(s)), "folders:")
    return Split(scheme.removesuffix(":"), (), (name,))


def _open(config: CapturesConfig, categories: list[str], trained: Trained) -> list[Capture]:
    match config.source:
        case "synthetic":
            return [
                _synthetic(config, category, index)
                for category in categories
                for index in range(config.sequences)
            ]
        case "co3d" | "folders":
            return [
                _with_cloud(s)
                for category in categories
                for s in _held_out_of(config, category, trained)
            ]
        case "reconfusion":
            return [_with_cloud(s) for s in _reconfusion(config)]
        case _:
            return [_with_cloud(_named(spec, categories)) for spec in config.scenes]


def freeze(config: CapturesConfig, rules: RulesConfig, captures: list[Capture]) -> Protocol:
    """Draw inputs and targets for every capture."""
    sequences = [capture.sequence for capture in captures]
    if config.source == "reconfusion":
        draws = [draw for one in sequences for draw in _given_draws(config, one, rules)]
    else:
        draws = [
            draw
            for one in sequences
            for draw in draw_sequence(
                one.category,
                one.name,
                [frame.name for frame in one.frames],
                stack_poses([frame.camera for frame in one.frames]),
                rules,
            )
        ]
    return Protocol(rules, tuple(draws))


def _synthetic(config: CapturesConfig, category: str, index: int) -> Capture:
    options = SyntheticConfig(frames=config.frames, image_size=config.render_size, seed=config.seed)

    def surface() -> TrueSurface:
        found = surface_points(build_scene(category, index, config.seed), DENSE_POINTS)
        points = torch.from_numpy(found.points).float()
        is_object = torch.from_numpy(found.is_object)
        return TrueSurface(points[is_object], points[~is_object])

    return Capture(synthetic_sequence(category, index, options), surface)


def _with_cloud(sequence: FrameSequence) -> Capture:
    cloud = sequence.point_cloud.find() if sequence.point_cloud else None
    if cloud is None:
        return Capture(sequence)
    return Capture(sequence, lambda: TrueSurface(read_points(cloud), torch.zeros(0, 3)))


def _held_out_of(config: CapturesConfig, category: str, trained: Trained) -> list[FrameSequence]:
    """The captures that the models' runs have held out; where no run says so, those that training
    on the same captures with its usual options does.
    """
    if config.root is None:
        raise InputError(
            f"captures.source={config.source} needs the captures: give captures.root=FOLDER"
        )
    read = capture_folders.read_category if config.source == "folders" else co3d.read_category
    sequences = {f"{s.category}/{s.name}": s for s in read(Path(config.root), category)}
    present = [sequence.name for sequence in sequences.values()]
    named = _held_out_by_all(trained, config.source, category, present, config.sequences)
    if named is not None:
        return [sequences[f"{category}/{name}"] for name in named]
    verdicts = judge_all(list(sequences.values()), PrepConfig())
    kept = [name for name, verdict in zip(sequences, verdicts, strict=True) if verdict.kept]
    if not kept:
        reasons = sorted({verdict.reason for verdict in verdicts})[:3]
        raise InputError(f"{config.root}/{category}: no usable capture ({'; '.join(reasons)})")
    split = split_sequences(kept, config.sequences)
    return [sequences[name] for name in (*split.test, *split.lone)]


def _reconfusion(config: CapturesConfig) -> list[FrameSequence]:
    """One folder per scene, as the split's authors publish it; frames are counted in name order."""
    if config.root is None:
        raise InputError("captures.source=reconfusion needs its folder: give captures.root=FOLDER")
    folders = sorted(file.parent for file in Path(config.root).glob(f"*/{TRANSFORMS}"))
    if not folders:
        raise InputError(f"{config.root}: no folder in it has a {TRANSFORMS}; check captures.root")
    return [replace(read_transforms(f), category="co3d", name=f.name) for f in folders]


@dataclass(frozen=True)
class _GivenSplit:
    """`train_test_split_N.json`: places of frames among all that are listed, in order of names."""

    train_ids: list[Annotated[int, Field(ge=0)]]
    test_ids: list[Annotated[int, Field(ge=0)]]


def _given_draws(config: CapturesConfig, capture: FrameSequence, rules: RulesConfig) -> list[Draw]:
    """The split files' own choice of inputs and targets."""
    draws = []
    listed, present = sorted(capture.listed), {frame.name for frame in capture.frames}
    for n_views in rules.views:
        file = Path(str(config.root)) / capture.name / f"train_test_split_{n_views}.json"
        split = read_record(file, _GivenSplit, "get it again")
        ids = [*split.train_ids, *split.test_ids]
        if max(ids, default=0) >= len(listed) or len(set(ids)) < len(ids):
            raise InputError(
                f"{file}: names a frame twice, or one beyond the {len(listed)} of {capture.name}; "
                "get it again"
            )
        inputs, targets = (
            tuple(listed[i] for i in part) for part in (split.train_ids, split.test_ids)
        )
        if missing := [name for name in (*inputs, *targets) if name not in present]:
            raise InputError(f"{file}: {missing[0]} is missing or cannot be used; get it again")
        draws.append(Draw(capture.category, capture.name, n_views, "given", 0, inputs, targets))
    return draws


def _named(spec: str, categories: list[str]) -> FrameSequence:
    """A capture that does not know its category takes the table's, if that is only one."""
    capture = open_scene(spec)
    if capture.category == NO_CATEGORY and len(categories) == 1:
        return replace(capture, category=categories[0])
    return capture
