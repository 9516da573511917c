"""Depth where nothing measures it: surfaces go on smoothly up to the picture's edges."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import spsolve
from torch import Tensor

COLOUR_SCALE = 0.06
"""Difference of colour (of a channel, in [0, 1]) that hints at another surface."""
REACH = 0.25
"""Share of the picture's side: farther from any known pixel nothing is continued."""
MIN_TIE = 1e-3
"""Between neighbours of any colours: everything is connected in the end."""


def continued_depth(
    depth: Float[Tensor, "h w"], image: Float[Tensor, "3 h w"]
) -> Float[Tensor, "h w"]:
    """The depth with its unknown pixels filled, but for those far from any known one.

    Inverse depth is harmonic over the unknown pixels, with ties between neighbours that are weak
    across edges of the picture (Levin et al., Colorization using Optimization, 2004): one sparse
    linear system. Known pixels stay as they are.
    """
    known = (depth > 0).numpy().ravel()
    if known.all() or not known.any():
        return depth
    ties = neighbour_ties(image.double().permute(1, 2, 0).numpy() / COLOUR_SCALE)
    inverse = np.where(known, 1 / np.where(known, depth.double().numpy().ravel(), 1), 0)
    inverse = extend_harmonically(inverse, known, ties).reshape(depth.shape)
    filled = np.where(_within_reach(known.reshape(depth.shape)), 1 / inverse, 0)
    return torch.from_numpy(filled).to(depth.dtype)


def extend_harmonically(
    values: Float[np.ndarray, " n"], known: Bool[np.ndarray, " n"], ties: csr_array, leak: float = 0
) -> Float[np.ndarray, " n"]:
    """The values with the unknown ones harmonic under the ties; with a leak they fade to 0 far from
    the known ones, which stay as they are.
    """
    laplacian = (diags_array(ties.sum(1) + leak) - ties).tocsr()
    extended = np.where(known, values, 0)
    inside = laplacian[~known]
    extended[~known] = spsolve(inside[:, ~known].tocsc(), -inside[:, known] @ extended[known])
    return extended


def _within_reach(known: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    return distance_transform_edt(~known) <= REACH * max(known.shape)


def neighbour_ties(image: Float[np.ndarray, "h w c"]) -> csr_array:
    """Symmetric weights between horizontal and vertical neighbours, whose values differ by 1 at an
    edge.
    """
    height, width, _ = image.shape
    index = np.arange(height * width).reshape(height, width)
    rows, columns, weights = [], [], []
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        difference = np.abs(image[one] - image[other]).max(-1)
        weight = (np.exp(-(difference**2)) + MIN_TIE).ravel()
        rows += [index[one].ravel(), index[other].ravel()]
        columns += [index[other].ravel(), index[one].ravel()]
        weights += [weight, weight]
    size = height * width
    return coo_array(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), (size, size)
    ).tocsr()
