"""Which frames of a sequence become pairs (paper III-A.1)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from extrap_train.config import PrepConfig
from extrap_train.geometry.compiled import compiled

_TIE = 1e6
"""Scores are compared in steps of 1 / this, so that rounding never decides between equals."""


@dataclass(frozen=True)
class Selection:
    """Ordered pairs (reference → query) of one sequence, best score first."""

    reference: Int[np.ndarray, " m"]
    query: Int[np.ndarray, " m"]
    angle_rad: Float[np.ndarray, " m"]
    score: Float[np.ndarray, " m"]


def pair_score(angle_rad: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """`cos α (1 − cos α)`: at most ¼, at 60°; 0 at 0° and 90°, then negative (paper III-A.1)."""
    cosine = np.cos(angle_rad)
    return cosine * (1 - cosine)


def select_pairs(
    angles_rad: Float[np.ndarray, "n n"],
    options: PrepConfig,
    queries: Bool[np.ndarray, " n"] | None = None,
    references: Bool[np.ndarray, " n"] | None = None,
) -> Selection:
    """Greedy choice of pairs: best score first, limited uses of a frame, no near-duplicates.

    The score is symmetric, so frames are chosen as *unordered* pairs, which `max_uses` counts;
    each gives both its orders, in so far as `queries` and `references` (all frames by default)
    allow them. Ties go to the lower indices.
    """
    everything = np.ones(len(angles_rad), bool)
    queries = everything if queries is None else queries
    references = everything if references is None else references
    allowed = references[:, None] & queries[None, :]
    first, second = _candidates(angles_rad, options, allowed | allowed.T)
    near = angles_rad < np.radians(options.near_duplicate_deg)
    taken = _greedy(first, second, near, options.max_uses)
    low, high = first[taken], second[taken]
    reference = np.stack([low, high], 1).reshape(-1)
    query = np.stack([high, low], 1).reshape(-1)
    keep = allowed[reference, query]
    reference, query = reference[keep], query[keep]
    angle = angles_rad[reference, query]
    return Selection(reference, query, angle, pair_score(angle))


def _candidates(
    angles_rad: Float[np.ndarray, "n n"], options: PrepConfig, allowed: Bool[np.ndarray, "n n"]
) -> tuple[Int[np.ndarray, " c"], Int[np.ndarray, " c"]]:
    """Unordered pairs (lower index first) within the range of angles, best score first."""
    wide = angles_rad >= np.radians(options.min_pair_angle_deg)
    narrow = angles_rad <= np.radians(options.max_pair_angle_deg)
    first, second = np.nonzero(np.triu(allowed & wide & narrow, 1))
    rank = np.rint(-_TIE * pair_score(angles_rad[first, second])).astype(np.int64)
    order = np.argsort(rank, kind="stable")
    return first[order], second[order]


@compiled()
def _greedy(first, second, near, max_uses):
    """Which candidates, in their order, are taken."""
    count = len(near)
    uses = np.zeros(count, np.int64)
    covered = np.zeros((count, count), np.bool_)
    taken = np.zeros(len(first), np.bool_)
    for candidate in range(len(first)):
        a, b = first[candidate], second[candidate]
        if uses[a] >= max_uses or uses[b] >= max_uses or covered[a, b]:
            continue
        taken[candidate] = True
        uses[a] += 1
        uses[b] += 1
        for i in np.flatnonzero(near[a]):
            for j in np.flatnonzero(near[b]):
                covered[i, j] = True
                covered[j, i] = True
    return taken
