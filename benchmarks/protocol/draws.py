"""Which frames are inputs and which are targets: drawn once, written down, hashed.

Farthest-point sampling picks a pool of nine frames; 3 or 6 of them are inputs, the rest targets. Of
`halves`, inputs and targets are from two halves of the capture instead.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from extrap_train.config import RulesConfig
from extrap_train.data.json_files import read_json
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import (
    camera_centers,
    farthest_point_sample,
    pairwise_angles,
    scene_center,
)
from extrap_train.store.atomic import write_atomic
from extrap_train.store.digests import json_digest
from extrap_train.store.records import read_record
from extrap_train.views import Camera


@dataclass(frozen=True)
class Draw:
    """One task: a capture's inputs and targets, by frame name."""

    category: str
    sequence: str
    n_views: int
    draw: str
    """How the inputs were drawn: one of `rules.draws`."""
    seed: int
    inputs: tuple[str, ...]
    targets: tuple[str, ...]

    @property
    def label(self) -> str:
        """Readable and unique within a protocol."""
        return f"{self.category}-{self.sequence}-{self.n_views}-{self.draw}-{self.seed}"


@dataclass(frozen=True)
class Protocol:
    """The rules of a table and every draw made by them, `protocol.json`."""

    rules: RulesConfig
    draws: tuple[Draw, ...]
    format: Literal[1] = 1

    @property
    def sha256(self) -> str:
        """SHA-256 of the whole content, which every result carries."""
        return json_digest(asdict(self))

    @classmethod
    def read(cls, file: Path) -> "Protocol":
        """A frozen protocol; raises InputError where its content is not what its hash says."""
        remedy = "delete it with the results beside it"
        protocol = read_record(file, cls, remedy)
        if not is_sealed(file):
            raise InputError(
                f"{file}: its content is not what its hash says; restore it, or {remedy}"
            )
        return protocol


def write_sealed(file: Path, record: object) -> None:
    """Write a dataclass as `read_record` reads it, with the digest of its content."""
    content: dict[str, Any] = asdict(record)  # type: ignore[call-overload]
    content["sha256"] = json_digest(content)
    write_atomic(file, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def is_sealed(file: Path) -> bool:
    """Whether a file holds what `write_sealed` wrote; InputError if it is not JSON."""
    content = read_json(file)
    return bool(content.pop("sha256", None) == json_digest(content))


def draw_sequence(
    category: str, sequence: str, names: Sequence[str], cameras: Camera, rules: RulesConfig
) -> list[Draw]:
    """Every draw of one capture for a table: kinds × seeds × numbers of views.

    Tables alone draw like this, from a pool of the capture, so that all methods share the targets;
    the commands choose inputs with `data.square_frames.select_input_frames` (all tasks about a
    scene) and `reconstruction.inputs.choose_frames` (`task=complete`).
    The draws of one kind and seed are nested, so that what six views add to three is theirs. Raises
    InputError where there are fewer frames than the pool takes.
    """
    if len(names) < rules.pool:
        raise InputError(
            f"{category}/{sequence}: has {len(names)} usable frames, and the protocol picks "
            f"{rules.pool}; leave it out, or give a smaller rules.pool="
        )
    pool = farthest_frames(cameras, rules.pool)
    angles = pairwise_angles(cameras, scene_center(cameras))[np.ix_(pool, pool)]
    draws = []
    for kind in rules.draws:
        for seed in rules.seeds:
            random = _generator(seed, category, sequence)
            if kind == "halves":
                draws += _halves(category, sequence, names, cameras, rules, seed, random)
                continue
            order = _ORDERS[kind](angles, random)
            for n_views in rules.views:
                chosen = set(order[:n_views])
                inputs = tuple(names[pool[i]] for i in range(len(pool)) if i in chosen)
                targets = tuple(names[pool[i]] for i in range(len(pool)) if i not in chosen)
                draws.append(Draw(category, sequence, n_views, kind, seed, inputs, targets))
    return draws


def _halves(
    category: str,
    sequence: str,
    names: Sequence[str],
    cameras: Camera,
    rules: RulesConfig,
    seed: int,
    random: np.random.Generator,
) -> list[Draw]:
    """Inputs from one half of the capture, targets from the other (as ArtiFixer evaluates).

    The two cameras that are farthest apart in angle are the poles; a half is the frames nearer to
    its pole. Farthest-point sampling from the poles picks the inputs, and as many targets as the
    pool would leave of the fewest inputs, the same for every number of inputs.
    """
    angles = pairwise_angles(cameras, scene_center(cameras))
    poles = np.unravel_index(angles.argmax(), angles.shape)
    near, far = random.permutation(poles)
    is_near = angles[near] <= angles[far]
    ours, theirs = np.flatnonzero(is_near), np.flatnonzero(~is_near)
    most = max(rules.views)
    if len(ours) < most or not len(theirs):
        raise InputError(
            f"{category}/{sequence}: its halves have {len(ours)} and {len(theirs)} frames, and "
            f"{most} inputs come from one; leave it out, or give smaller rules.views="
        )
    positions = camera_centers(cameras)

    def pick(half: Int[np.ndarray, " m"], pole: int, count: int) -> list[int]:
        start = int(np.flatnonzero(half == pole)[0])
        chosen = farthest_point_sample(positions[half], min(count, len(half)), start)
        return [int(index) for index in half[chosen]]

    order = pick(ours, int(near), most)
    targets = sorted(pick(theirs, int(far), rules.pool - min(rules.views)))
    return [
        Draw(
            category,
            sequence,
            n_views,
            "halves",
            seed,
            inputs=tuple(names[index] for index in sorted(order[:n_views])),
            targets=tuple(names[index] for index in targets),
        )
        for n_views in rules.views
    ]


def farthest_frames(cameras: Camera, count: int) -> list[int]:
    """Farthest-point sampling on the camera positions, from the one nearest to their mean on; in
    the capture's order.
    """
    positions = camera_centers(cameras)
    start = int(np.linalg.norm(positions - positions.mean(0), axis=1).argmin())
    return sorted(farthest_point_sample(positions, count, start).tolist())


def _generator(seed: int, category: str, sequence: str) -> np.random.Generator:
    """The capture's own, whatever other captures there are."""
    name = hashlib.sha256(f"{seed}/{category}/{sequence}".encode()).digest()
    return np.random.default_rng(int.from_bytes(name[:8], "big"))


def _random(angles: Float[np.ndarray, "n n"], rng: np.random.Generator) -> list[int]:
    """As in the paper: well spread, clustered on one side, or between."""
    return [int(i) for i in rng.permutation(len(angles))]


def _spread(angles: Float[np.ndarray, "n n"], rng: np.random.Generator) -> list[int]:
    """Each the farthest in angle from those before it."""
    chosen = [int(rng.integers(len(angles)))]
    while len(chosen) < len(angles):
        apart = angles[:, chosen].min(1)
        apart[chosen] = -1
        chosen.append(int(apart.argmax()))
    return chosen


def _one_sided(angles: Float[np.ndarray, "n n"], rng: np.random.Generator) -> list[int]:
    """The nearest in angle to one of them."""
    center = int(rng.integers(len(angles)))
    return [int(i) for i in np.argsort(angles[center], kind="stable")]


_ORDERS = {"random": _random, "spread": _spread, "one_sided": _one_sided}
