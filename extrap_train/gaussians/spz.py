"""Gaussians as SPZ files, about a seventh of their PLY's size, written by gsply (extra `spz`)."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_file

_LARGEST = 2**23 - 1
"""Positions are signed integers of 24 bits."""
_MOST_BITS = 24


def require_gsply() -> None:
    """InputError where the library that writes SPZ is not installed."""
    if find_spec("gsply") is None:
        raise InputError(
            'complete.splats.spz=true needs gsply: pip install "extrap-train[spz]", or leave it out'
        )


def write_spz(ply: Path, path: Path) -> None:
    """Write the Gaussians of a PLY file as SPZ version 3, in the coordinates of that file.

    Positions get as many binary places as leave room for the farthest: 2⁻²⁴ of it or less is lost.
    """
    import gsply  # it compiles and loads for a while

    splats = gsply.plyread(ply)
    farthest = max(float(np.abs(splats.means).max(initial=0.0)), 2.0**-2)
    places = int(np.clip(np.floor(np.log2(_LARGEST / farthest)), 1, _MOST_BITS))
    with atomic_file(path) as temporary:
        gsply.write_spz(temporary, splats, version=3, fractional_bits=places)
