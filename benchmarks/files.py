"""Files as results are written and read: JSON of the same bytes for the same content, clouds."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from plyfile import PlyData, PlyParseError
from torch import Tensor

from extrap_train.errors import InputError


def json_bytes(content: Any) -> bytes:
    """Indented, with a last line end; NaN is refused, since JSON has none."""
    return (json.dumps(content, indent=1, allow_nan=False) + "\n").encode()


def read_points(path: Path) -> Float[Tensor, "m 3"]:
    """The points of a PLY file."""
    try:
        vertices = PlyData.read(path)["vertex"]
        columns = [np.asarray(vertices[axis], np.float32) for axis in ("x", "y", "z")]
    except (OSError, PlyParseError, KeyError, ValueError) as error:
        raise InputError(f"{path}: no points can be read ({error}); restore the file") from None
    return torch.from_numpy(np.stack(columns, 1))
