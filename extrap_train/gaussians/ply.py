"""Gaussians as PLY files, in the layout of the 3DGS authors, which the usual viewers read.

One vertex a Gaussian, little-endian floats: `x y z`, `nx ny nz` (zeros), `f_dc_*` (degree 0),
`f_rest_*` (the other coefficients, all of red, then green, then blue), `opacity` (its logit),
`scale_*` (logarithms), `rot_*` (unit quaternion w, x, y, z). The third line of the header is the
number of vertices, whatever it says besides: there the authors' own viewer looks for it.
"""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError
from torch.nn import functional

from extrap_train.errors import InputError
from extrap_train.gaussians.gaussian_model import Gaussians
from extrap_train.store.atomic import write_atomic

_EPSILON = 1e-6
"""Opacities are kept this far from 0 and 1, whose logits are infinite."""
_LEAST_SCALE = float(torch.finfo(torch.float32).tiny)
"""The logarithm of 0 is infinite. No other size is too small: worlds have any unit."""
_DEGREES = range(4)


def write_splats(path: Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> None:
    """Write a PLY file, whole or not at all; `comments` are lines of its header."""
    dc, rest = gaussians.sh[:, 0], gaussians.sh[:, 1:].mT.flatten(1)
    columns = [
        gaussians.means,
        torch.zeros_like(gaussians.means),
        dc,
        rest,
        gaussians.opacities.clamp(_EPSILON, 1 - _EPSILON).logit()[:, None],
        gaussians.scales.clamp(min=_LEAST_SCALE).log(),
        functional.normalize(gaussians.quats, dim=-1),
    ]
    table = torch.cat(columns, 1).detach().cpu().numpy().astype("<f4")
    dtype = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz", *_rest(rest.shape[1]))]
    vertices = np.ascontiguousarray(table).view(dtype)[:, 0]
    content = io.BytesIO()
    element = PlyElement.describe(vertices, "vertex", comments=list(comments))
    PlyData([element], byte_order="<").write(content)
    write_atomic(path, content.getvalue())


def read_splats(path: Path) -> Gaussians:
    """Read a PLY file of any SH degree up to 3, ours or another trainer's."""
    vertices = _read(path)["vertex"].data
    given = vertices.dtype.names or ()
    count = sum(name.startswith("f_rest_") for name in given)
    bands = {3 * ((degree + 1) ** 2 - 1) for degree in _DEGREES}
    if count not in bands:
        raise InputError(
            f"{path}: has {count} f_rest properties, and no SH degree up to {_DEGREES[-1]} has "
            f"that many; expected one of {sorted(bands)}"
        )
    names = ("x", "y", "z", *_rest(count))
    missing = [name for name in names if name not in given]
    if missing:
        raise InputError(
            f"{path}: lacks {', '.join(missing)}; it is no 3DGS file (a plain point cloud?)"
        )
    columns = [np.asarray(vertices[name], np.float32) for name in names]
    table = torch.from_numpy(np.stack(columns, 1))
    if not table.isfinite().all():
        bad = int((~table.isfinite()).any(1).sum())
        raise InputError(f"{path}: {bad} Gaussians hold NaN or infinity; export it again")
    means, dc, rest, opacity, scale, quats = table.split([3, 3, count, 1, 3, 4], 1)
    sh = torch.cat([dc[:, None], rest.unflatten(1, (3, count // 3)).mT], 1)
    return Gaussians(means, quats, scale.exp(), opacity[:, 0].sigmoid(), sh)


def read_comments(path: Path) -> tuple[str, ...]:
    """The lines that a PLY file's header says to people."""
    content = _read(path)
    return (*content.comments, *content["vertex"].comments)


def _rest(count: int) -> list[str]:
    """Names of the properties after position and normal."""
    names = [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(count)]
    return [*names, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def _read(path: Path) -> PlyData:
    try:
        with path.open("rb") as file:
            content = PlyData.read(file)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (PlyParseError, ValueError, KeyError, MemoryError) as error:
        raise InputError(
            f"{path}: is not a PLY file with vertices ({error}); export it again"
        ) from None
    if "vertex" not in content:
        raise InputError(f"{path}: is not a PLY file with vertices; export it again")
    return content
