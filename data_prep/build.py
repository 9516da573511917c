"""Preparation of a category: filter, split, every sequence as a unit of its own, tables."""

import hashlib
import json
import logging
import shutil
from collections import Counter
from collections.abc import Collection
from collections.abc import Sequence as ListOf
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from tqdm import tqdm

from data_prep.filter import judge_all
from data_prep.frames import frames_key
from data_prep.split import Split, split_sequences
from data_prep.tables import Outcome, write_results
from data_prep.tools import Tools, put_away
from data_prep.unit import NO_SPACE, Unit, Workshop, prepare_unit
from extrap_train.config import DepthConfig, MatcherConfig, PrepConfig
from extrap_train.data.files import remove_partial
from extrap_train.data.frame_files import sequence_folder
from extrap_train.data.sequences import Sequence
from extrap_train.data.store import FORMAT, PreparedData, read_manifest
from extrap_train.depth import DepthSource
from extrap_train.errors import InputError
from extrap_train.jobs import Died, Launcher
from extrap_train.jobs.local import LocalLauncher
from extrap_train.matching import Matcher

LOG = logging.getLogger(__name__)
HERE = LocalLauncher(1)
"""Runs units one after the other in this process."""
_BYTES_PER_PIXEL = 3 + 2 + 1
"""Of a stored frame: colours, depth, mask."""


@dataclass(frozen=True)
class _Plan:
    """What decides everything about a preparation but where it runs."""

    sequences: ListOf[Sequence]
    workshop: Workshop
    test_names: Collection[str] | int

    @property
    def key(self) -> str:
        """A hash of all of it."""
        test = self.test_names if isinstance(self.test_names, int) else sorted(self.test_names)
        shop = self.workshop
        how = [asdict(shop.options), test, shop.correction]
        digest = hashlib.sha256(json.dumps([FORMAT, *how]).encode())
        for sequence in self.sequences:
            qualities = [sequence.viewpoint_quality, sequence.point_cloud_quality]
            digest.update(json.dumps([sequence.category, sequence.name, qualities]).encode())
            frames = frames_key(sequence, shop.tools.depth, shop.options.image_size, False)
            digest.update(frames.encode())
        return digest.hexdigest()


def prepare(
    sequences: ListOf[Sequence],
    depth: DepthConfig | DepthSource,
    options: PrepConfig,
    *,
    test_names: Collection[str] | int,
    folder: Path,
    frames: Path | None = None,
    matcher: MatcherConfig | Matcher | None = None,
    launcher: Launcher = HERE,
    progress: bool = True,
    retry: bool = True,
) -> PreparedData:
    """Make pair data from sequences, or open what an equal earlier call has made.

    `frames` is the folder of the frames, which calls with other pair options may share; the same
    as `folder` by default. Training warps are corrected where there is a `matcher`. Options of both
    are made to tools where the jobs run; ready tools go along with the jobs. A sequence that
    cannot be used is dropped with its reason, and tried again by the next call unless `retry` is
    False. Finished sequences are kept whatever ends the call. Raises InputError where no sequence
    is left, or the disk is full.
    """
    shop = Workshop(Tools(depth, matcher), options, frames or folder, folder)
    plan = _Plan(sequences, shop, test_names)
    key = plan.key
    if _is_finished(folder, key, retry):
        LOG.info("%s is prepared already and used as it is", folder)
        return PreparedData.open(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "manifest.json").unlink(missing_ok=True)
        outcomes, split = _make_all(plan, launcher, progress)
        _remove_partial(shop, sequences)
        write_results(shop, outcomes, split, key)
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        raise InputError(_disk_full(folder, sequences, options)) from None
    finally:
        put_away()
    return PreparedData.open(folder)


def _remove_partial(shop: Workshop, sequences: ListOf[Sequence]) -> None:
    """What killed runs have left half-written."""
    remove_partial(shop.folder)
    for category in {sequence.category for sequence in sequences}:
        for root, kind in ((shop.frames, "frames"), (shop.folder, "pairs")):
            remove_partial(sequence_folder(root, kind, category))


def _is_finished(folder: Path, key: str, retry: bool) -> bool:
    if not (folder / "manifest.json").exists():
        return False
    manifest = read_manifest(folder)
    failed = manifest["sequences"]["failed"]
    if manifest.get("key") == key and failed and retry:
        LOG.warning("%s: %d sequences failed before and are tried again", folder, failed)
        return False
    return bool(manifest.get("key") == key)


def _make_all(plan: _Plan, launcher: Launcher, progress: bool) -> tuple[list[Outcome], Split]:
    """Every sequence's outcome, and the split of those that are kept.

    Who is tested on depends on who is left, so after failures the split is made anew, and what it
    gives another role is made again.
    """
    outcomes = [
        Outcome(sequence, verdict, failed=False)
        for sequence, verdict in zip(
            plan.sequences, judge_all(plan.sequences, plan.workshop.options), strict=True
        )
    ]
    made: dict[str, str] = {}
    while True:
        kept = {o.name: number for number, o in enumerate(outcomes) if o.verdict.kept}
        if not kept:
            raise InputError(_nothing_left(outcomes))
        split = split_sequences(list(kept), plan.test_names)
        roles = {name: split.role(name) for name in kept}
        units = [
            Unit(plan.workshop, outcomes[number].sequence, roles[name])
            for name, number in kept.items()
            if made.get(name) != roles[name]
        ]
        if not units:
            return outcomes, split
        done = launcher.run(prepare_unit, units)
        bar = tqdm(done, "preparing", len(units), unit="sequence", disable=not progress)
        for index, reason in bar:
            unit = units[index]
            made[unit.name] = unit.role
            if reason:
                reason = reason.reason if isinstance(reason, Died) else reason
                number = kept[unit.name]
                verdict = replace(outcomes[number].verdict, kept=False, reason=reason)
                outcomes[number] = replace(outcomes[number], verdict=verdict, failed=True)
                LOG.warning("left out: %s", reason)


def _nothing_left(outcomes: list[Outcome]) -> str:
    if not outcomes:
        return "no sequence to prepare; check the category and the data set's root"
    reasons = Counter(outcome.verdict.reason for outcome in outcomes).most_common(3)
    listed = "; ".join(f"{count} times {reason}" for reason, count in reasons)
    return (
        f"none of the {len(outcomes)} sequences of {outcomes[0].sequence.category} can be used: "
        f"{listed}. Loosen prep.* (prep.full_circle=ignore keeps partial turns) or add sequences"
    )


def _disk_full(folder: Path, sequences: ListOf[Sequence], options: PrepConfig) -> str:
    frames = sum(len(sequence.frames) for sequence in sequences)
    needed = frames * options.image_size**2 * _BYTES_PER_PIXEL / 2**20
    free = shutil.disk_usage(folder.parent).free / 2**20
    return (
        f"{folder}: no space left on the device ({free:.0f} MiB free, up to {needed:.0f} MiB "
        "needed in all); free some or choose another output=, finished sequences are kept"
    )
