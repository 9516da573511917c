"""Preparation of a category: filter, split, one job per sequence, tables."""

import hashlib
import json
import logging
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from data_prep.correct import CORRECTION_VERSION
from data_prep.filter import group_reasons, judge_all
from data_prep.model_cache import PrepModels, release_models
from data_prep.sequence_job import NO_SPACE, PrepContext, SequenceJob, prepare_sequence
from data_prep.split import SequenceSplit, split_sequences
from data_prep.tables import SequenceOutcome, write_results
from extrap_train.config import DepthConfig, MatcherConfig, PrepConfig
from extrap_train.data.prepared import FORMAT, PreparedData
from extrap_train.data.sequences import FrameSequence
from extrap_train.data.square_frames import FRAMES_VERSION, CaptureKeys, too_many_unusable
from extrap_train.depth import DepthSource
from extrap_train.errors import InputError
from extrap_train.jobs import Died, Launcher
from extrap_train.jobs.local import LocalLauncher
from extrap_train.matching import Matcher
from extrap_train.store.atomic import remove_leftovers
from extrap_train.terminal import track

LOG = logging.getLogger(__name__)
HERE = LocalLauncher(1)
"""Runs jobs one after the other in this process."""
_BYTES_PER_PIXEL = 3 + 2 + 1
"""Bytes per pixel of a stored frame: colours, depth, mask."""


@dataclass(frozen=True)
class _Plan:
    """What decides everything about a preparation but where it runs."""

    captures: Sequence[tuple[FrameSequence, str]]
    """With what their frames are made from (`CaptureKeys.frames_key`)."""
    context: PrepContext
    test_names: Collection[str] | int
    key: str
    """A hash of options and captures: the same on every machine."""

    @classmethod
    def of(
        cls,
        sequences: Sequence[FrameSequence],
        context: PrepContext,
        test_names: Collection[str] | int,
    ) -> "_Plan":
        """Looks at the files of every capture, once."""
        models, options = context.models, context.options
        test = test_names if isinstance(test_names, int) else sorted(test_names)
        settings = [FORMAT, asdict(options), test, repr(models), FRAMES_VERSION, CORRECTION_VERSION]
        digest = hashlib.sha256(json.dumps(settings).encode())
        depth, size = models.depth_identity, options.image_size
        captures = []
        for sequence in sequences:
            keys = CaptureKeys.of(sequence)
            captures.append((sequence, keys.frames_key(depth, size)))
            qualities = [sequence.viewpoint_quality, sequence.point_cloud_quality]
            traits = [sequence.category, sequence.name, qualities, keys.content, keys.sizes]
            lost = [len(sequence.left_out)] if sequence.left_out else []
            digest.update(json.dumps([*traits, *lost]).encode())
        return cls(captures, context, test_names, digest.hexdigest())

    @property
    def keys(self) -> dict[str, str]:
        """What the manifest says: `key`, and `files` of the very files that were read."""
        files = json.dumps([*(key for _, key in self.captures), self.context.correction])
        return {"key": self.key, "files": hashlib.sha256(files.encode()).hexdigest()}


def prepare(
    sequences: Sequence[FrameSequence],
    depth: DepthConfig | DepthSource,
    options: PrepConfig,
    *,
    test_names: Collection[str] | int,
    folder: Path,
    frames: Path | None = None,
    pairs: Path | None = None,
    matcher: MatcherConfig | Matcher | None = None,
    launcher: Launcher = HERE,
    progress: bool = True,
    retry: bool = True,
    source: Mapping[str, Any] | None = None,
) -> PreparedData:
    """Make pair data from sequences, or open what an equal earlier call has made.

    `frames` and `pairs` are the folders of each sequence's frames and pairs, which calls with other
    options may share; the same as `folder` by default. Training warps are corrected where there is
    a `matcher`. Options of both are built where the jobs run; ready ones are sent with the jobs.

    A sequence that cannot be used is dropped with its reason, and tried again by the next call
    unless `retry` is False. Finished sequences are kept whatever ends the call. The manifest holds
    `source`, what the captures came from. Raises InputError where no sequence is left, or the disk
    is full.
    """
    models = PrepModels(depth, matcher)
    context = PrepContext(models, options, frames or folder, pairs or folder)
    plan = _Plan.of(sequences, context, test_names)
    if _is_finished(plan, folder, retry):
        print(f"{folder}: prepared already, used as it is")
        return PreparedData.open(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "preparation.json").unlink(missing_ok=True)
        outcomes, split = _make_all(plan, launcher, progress)
        for place in (folder, *context.frames_root.glob("*/*"), *context.pairs_root.glob("*/*")):
            remove_leftovers(place)
        write_results(folder, context, outcomes, split, {**plan.keys, "data": source})
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        raise InputError(_disk_full(folder, sequences, options)) from None
    finally:
        release_models()
    return PreparedData.open(folder)


def _is_finished(plan: _Plan, folder: Path, retry: bool) -> bool:
    """Whether an equal preparation is there and nothing that it stands on has been changed."""
    if not (folder / "preparation.json").exists():
        return False
    try:
        data = PreparedData.open(folder)
    except InputError as error:
        LOG.warning("%s", error)
        return False
    if any(data.manifest.get(name) != key for name, key in plan.keys.items()):
        print(f"{folder}: made from other photographs, weights or options: brought up to date")
        return False
    failed = data.manifest["sequences"]["failed"]
    if failed and retry:
        LOG.warning("%s: %d sequences failed before and are tried again", folder, failed)
        return False
    jobs = [
        SequenceJob(plan.context, sequence, role, key)
        for sequence, key in plan.captures
        if (role := data.roles.get(f"{sequence.category}/{sequence.name}"))
    ]
    damaged = [job.name for job in jobs if not job.is_there]
    if damaged:
        LOG.warning(
            "%s: frames or pairs of %d sequences (first: %s) are damaged, gone or replaced: "
            "made anew",
            folder,
            len(damaged),
            damaged[0],
        )
    return not damaged


def _make_all(
    plan: _Plan, launcher: Launcher, progress: bool
) -> tuple[list[SequenceOutcome], SequenceSplit]:
    """Every sequence's outcome, and the split of those that are kept.

    Who is tested on depends on who is left, so after failures the split is made anew, and what it
    gives another role is made again.
    """
    verdicts = judge_all([sequence for sequence, _ in plan.captures], plan.context.options)
    outcomes = [
        SequenceOutcome(*capture, verdict)
        for capture, verdict in zip(plan.captures, verdicts, strict=True)
    ]
    made: dict[str, str] = {}
    while True:
        kept = {o.name: number for number, o in enumerate(outcomes) if o.verdict.kept}
        if not kept:
            raise InputError(_nothing_left(outcomes))
        split = split_sequences(list(kept), plan.test_names)
        roles = {name: split.role(name) for name in kept}
        shown = progress and len(kept) == 1
        jobs = [
            outcomes[number].job(plan.context, roles[name], progress=shown)
            for name, number in kept.items()
            if made.get(name) != roles[name]
        ]
        if not jobs:
            return outcomes, split
        done = launcher.run(prepare_sequence, jobs)
        for index, reason in track(done, "preparing", len(jobs), "sequences", shown=progress):
            job = jobs[index]
            made[job.name] = job.role
            if reason:
                number = kept[job.name]
                outcomes[number] = _left_out(outcomes[number], reason)


def _left_out(outcome: SequenceOutcome, reason: str | Died) -> SequenceOutcome:
    """What becomes of a sequence that could not be prepared; says so."""
    if isinstance(reason, Died):
        reason = f"sequence {outcome.name}: {reason.reason}"
    LOG.warning("left out: %s", reason)
    verdict = replace(outcome.verdict, kept=False, reason=reason)
    return replace(outcome, verdict=verdict, failed=True)


def _nothing_left(outcomes: list[SequenceOutcome]) -> str:
    if not outcomes:
        return "no sequence to prepare; check the category and the data set's root"
    groups = group_reasons(o.verdict.reason.removeprefix(f"sequence {o.name}: ") for o in outcomes)
    listed = "; ".join(group.counted for group in groups[:3])
    remedies = ["add sequences"]
    damaged = [_is_damaged(outcome) for outcome in outcomes]
    if not all(damaged):
        remedies.insert(0, "loosen prep.* (prep.full_circle=ignore keeps partial turns)")
    if any(damaged):
        remedies.insert(0, "mend what is named")
    return (
        f"none of the {len(outcomes)} sequences of {outcomes[0].sequence.category} can be used: "
        f"{listed}. To go on, {' or '.join(remedies)}"
    )


def _is_damaged(outcome: SequenceOutcome) -> bool:
    """Whether no option could keep the sequence."""
    sequence = outcome.sequence
    return outcome.failed or bool(too_many_unusable(sequence.left_out, sequence))


def _disk_full(folder: Path, sequences: Sequence[FrameSequence], options: PrepConfig) -> str:
    frames = sum(len(sequence.frames) for sequence in sequences)
    needed = frames * options.image_size**2 * _BYTES_PER_PIXEL / 2**20
    free = shutil.disk_usage(folder.parent).free / 2**20
    return (
        f"{folder}: no space left on the device ({free:.0f} MiB free, up to {needed:.0f} MiB "
        "needed in all); free some or choose another output=, finished sequences are kept"
    )
