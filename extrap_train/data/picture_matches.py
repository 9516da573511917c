"""A matcher's matches as keypoints and index pairs, for `structure_from_motion`.

A matcher without a detector finds other points in every pair of pictures. Points of one picture
that lie in one cell of a grid become one keypoint, so that tracks form through several pictures.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image
from torch import Tensor

from extrap_train.data.structure_from_motion import MATCHES, pairs_to_match
from extrap_train.matching import Matcher, Matches, SeparableMatcher
from extrap_train.terminal import progress

CELL = 2.0
"""Side of a cell, in pixels of the pictures that are matched."""


def write_matches(matcher: Matcher, folder: Path, files: Sequence[str]) -> None:
    """Match the pictures of these names in the folder and write `folder/MATCHES`.

    The file holds for each picture an array of its name, (keypoints, 2), in pixels, and for each
    pair with matches an array called `FIRST SECOND`, (matches, 2), of indices of keypoints.
    """
    pairs = [pair for found in pairs_to_match(len(files)) for pair in found]
    points: list[list[Float[np.ndarray, "n 2"]]] = [[] for _ in files]
    places, confidences = [], []
    match = _matching(matcher, [folder / file for file in files])
    with progress("matching photographs", len(pairs), "pairs") as bar:
        for i, j in pairs:
            matches = match(i, j)
            places.append((len(points[i]), len(points[j])))
            points[i].append(matches.first.float().numpy(force=True))
            points[j].append(matches.second.float().numpy(force=True))
            confidences.append(matches.confidence.numpy(force=True))
            bar.advance()
    merged = [merge_points(found) for found in points]
    # Any: NumPy since 2.2 has a keyword of type bool, which its older versions take for an array.
    arrays: dict[str, Any] = {f: keypoints for f, (keypoints, _) in zip(files, merged, strict=True)}
    for (i, j), (at_i, at_j), confidence in zip(pairs, places, confidences, strict=True):
        indices = np.stack([merged[i][1][at_i], merged[j][1][at_j]], 1)
        if len(indices):
            arrays[f"{files[i]} {files[j]}"] = keep_best(indices, confidence)
    np.savez(folder / MATCHES, **arrays)


def _matching(matcher: Matcher, paths: Sequence[Path]) -> Callable[[int, int], Matches]:
    """How two of the pictures are matched, each looked at only once if the matcher allows it."""
    if not isinstance(matcher, SeparableMatcher):
        return lambda i, j: matcher.match(_read(paths[i]), _read(paths[j]))
    described = []
    with progress("looking at photographs", len(paths), "photographs") as bar:
        for path in paths:
            described.append(matcher.describe(_read(path)))
            bar.advance()
    return lambda i, j: matcher.match_described(described[i], described[j])


def _read(path: Path) -> Float[Tensor, "3 h w"]:
    """A picture of the job's folder, colours in [0, 1]."""
    with Image.open(path) as picture:
        return torch.from_numpy(np.array(picture.convert("RGB"))).permute(2, 0, 1) / 255


def merge_points(
    points: Sequence[Float[np.ndarray, "_ 2"]],
) -> tuple[Float[np.ndarray, "k 2"], list[Int[np.ndarray, " _"]]]:
    """One picture's keypoints, at the mean of the points in each cell, and the points' indices."""
    if not points:
        return np.zeros((0, 2)), []
    together = np.concatenate(points)
    cells = np.floor(together / CELL).astype(np.int64)
    inverse = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    counts = np.bincount(inverse)
    keypoints = np.stack([np.bincount(inverse, axis) / counts for axis in together.T], 1)
    ends = np.cumsum([len(found) for found in points])
    return keypoints, np.split(inverse, ends[:-1])


def keep_best(
    pairs: Int[np.ndarray, "n 2"], confidence: Float[np.ndarray, " n"]
) -> Int[np.ndarray, "m 2"]:
    """Of the pairs that share a keypoint the most certain one."""
    kept = pairs[np.argsort(-confidence, kind="stable")]
    for side in (0, 1):
        kept = kept[np.sort(np.unique(kept[:, side], return_index=True)[1])]
    return kept
