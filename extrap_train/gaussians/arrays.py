"""Tensors as the compiled loops see them."""

import numpy as np
from jaxtyping import Float
from torch import Tensor


def array(tensor: Float[Tensor, "*b"]) -> Float[np.ndarray, "*b"]:
    """The tensor's own memory where it is contiguous, else a contiguous copy."""
    return tensor.detach().contiguous().numpy()
