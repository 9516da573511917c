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
"""Of the picture's side: farther from any known pixel nothing is continued."""
LEAST_TIE = 1e-3
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
    height, width = depth.shape
    ties = _ties(image.double().permute(1, 2, 0).numpy())
    laplacian = (diags_array(ties.sum(1)) - ties).tocsr()
    inverse = np.zeros(height * width)
    inverse[known] = 1 / depth.double().numpy().ravel()[known]
    inside = laplacian[~known]
    inverse[~known] = spsolve(inside[:, ~known].tocsc(), -inside[:, known] @ inverse[known])
    filled = np.where(
        _within_reach(known.reshape(height, width)), 1 / inverse.reshape(height, width), 0
    )
    return torch.from_numpy(filled).to(depth.dtype)


def _within_reach(known: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    return distance_transform_edt(~known) <= REACH * max(known.shape)


def _ties(image: Float[np.ndarray, "h w 3"]) -> csr_array:
    """Symmetric weights between horizontal and vertical neighbours."""
    height, width, _ = image.shape
    index = np.arange(height * width).reshape(height, width)
    rows, columns, weights = [], [], []
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        difference = np.abs(image[one] - image[other]).max(-1) / COLOUR_SCALE
        weight = (np.exp(-(difference**2)) + LEAST_TIE).ravel()
        rows += [index[one].ravel(), index[other].ravel()]
        columns += [index[other].ravel(), index[one].ravel()]
        weights += [weight, weight]
    size = height * width
    return coo_array(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), (size, size)
    ).tocsr()
