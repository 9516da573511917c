"""Gaussians as SPZ files, about a seventh of their PLY's size, written by gsply (extra `spz`)."""

import logging
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_file

_LARGEST = 2**23 - 1
"""Positions are signed integers of 24 bits."""
_MOST_BITS = 24
_LEAST_LOG_SCALE, _GREATEST_LOG_SCALE = -10.0, 255 / 16 - 10
"""Logarithms of scales are bytes, in steps of 1/16: from 0.000045 to 380 units of the world."""
_MAX_SHARE_BEYOND = 0.01

log = logging.getLogger(__name__)


def require_gsply() -> None:
    """InputError where the library that writes SPZ is not installed."""
    if find_spec("gsply") is None:
        raise InputError(
            'complete.splats.spz=true needs gsply: pip install "extrap-train[spz]", or leave it out'
        )


def write_spz(ply: Path, path: Path) -> None:
    """Write the Gaussians of a PLY file as SPZ version 3, in the coordinates of that file.

    Positions get as many binary places as leave room for the farthest: 2⁻²⁴ of it or less is lost.
    Warns where the format cannot hold the sizes of more than a hundredth of them.
    """
    import gsply  # it compiles and loads for a while

    splats = gsply.plyread(ply)
    farthest = max(float(np.abs(splats.means).max(initial=0.0)), 2.0**-2)
    places = int(np.clip(np.floor(np.log2(_LARGEST / farthest)), 1, _MOST_BITS))
    with atomic_file(path) as temporary:
        gsply.write_spz(temporary, splats, version=3, fractional_bits=places)
    widest = splats.scales.max(1)
    beyond = ((widest < _LEAST_LOG_SCALE) | (widest > _GREATEST_LOG_SCALE)).mean()
    if beyond > _MAX_SHARE_BEYOND:
        log.warning(
            "%s: %.0f %% of its Gaussians are smaller or larger than SPZ can say (%.2g to %.2g "
            "units); use splats.ply",
            path,
            100 * beyond,
            np.exp(_LEAST_LOG_SCALE),
            np.exp(_GREATEST_LOG_SCALE),
        )
