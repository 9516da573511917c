"""Which pixels of a reference can show anything in the query at all.

Close to the query a reference's pixel is cut into many points, and most of what is so close lies
outside the image: this test is what keeps them from being made.
"""

import numpy as np

from extrap_train.geometry.compiled import compiled

_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_RIM = np.float32(1.5)
"""Query pixels around the image: the splat draws what lies half a pixel outside; the rest is for
rounding."""


@compiled()
def enters(
    m: np.ndarray, inverse: np.ndarray, slopes: np.ndarray, y: int, x: int, size: tuple[int, int]
) -> bool:
    """Whether any of a pixel's surface may lie in the query's image, or within `_RIM` of it.

    Never wrongly no; wrongly yes at most near the image's corners. In homogeneous coordinates each
    side of the image is a linear function of the place in each quarter of the pixel, so its
    greatest value lies at a corner.
    """
    height, width = np.float32(size[0]), np.float32(size[1])
    return bool(
        _greatest(m, inverse, slopes, y, x, _ZERO, _ZERO, _ONE) > _ZERO
        and _greatest(m, inverse, slopes, y, x, _ONE, _ZERO, _RIM) > _ZERO
        and _greatest(m, inverse, slopes, y, x, -_ONE, _ZERO, width + _RIM) > _ZERO
        and _greatest(m, inverse, slopes, y, x, _ZERO, _ONE, _RIM) > _ZERO
        and _greatest(m, inverse, slopes, y, x, _ZERO, -_ONE, height + _RIM) > _ZERO
    )


@compiled()
def _greatest(
    m: np.ndarray,
    inverse: np.ndarray,
    slopes: np.ndarray,
    y: int,
    x: int,
    a: float,
    b: float,
    c: float,
) -> float:
    """Of `a·X + b·Y + c·ratio` over a pixel, (X, Y) / ratio being its place in the query."""
    along_u = a * m[0, 0] + b * m[1, 0] + c * m[2, 0]
    along_v = a * m[0, 1] + b * m[1, 1] + c * m[2, 1]
    constant = a * m[0, 2] + b * m[1, 2] + c * m[2, 2]
    along_w = a * m[0, 3] + b * m[1, 3] + c * m[2, 3]
    middle = along_u * (np.float32(x) + _HALF) + along_v * (np.float32(y) + _HALF) + constant
    middle += along_w * inverse[y, x]
    left = -(along_u + along_w * slopes[0, y, x])
    right = along_u + along_w * slopes[1, y, x]
    up = -(along_v + along_w * slopes[2, y, x])
    down = along_v + along_w * slopes[3, y, x]
    return middle + _HALF * (max(left, right, _ZERO) + max(up, down, _ZERO))
