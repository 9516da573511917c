"""The projection of Gaussians and its derivative: compiled loops, parallel over blocks of them.

Everything between loading and storing is in double precision: needles and sheets lose all digits
otherwise. The pose's gradient is summed block by block, so that it does not depend on threads.
"""

import math

import numba
import numpy as np

from extrap_train.geometry.compiled import compiled

MIN_ALPHA = 1 / 255
"""What covers a pixel less than this is left out."""
_MAX_SIGMAS = 3.33
_VIEW_MARGIN = 0.3
"""Slopes are clamped at this share of half the field of view beyond the image's edge."""
_BLOCK = 256


@compiled(parallel=True)
def project_forward(means, quats, scales, opacities, lens, means2d, shapes, depths, radii):
    """Fill the four outputs; zeros for what is not drawn.

    `lens` is world_to_cam, intrinsics, width, height, near plane and low pass.
    """
    world_to_cam, k, width, height, near, low_pass = lens
    for block in numba.prange(-(-len(means) // _BLOCK)):
        turn, axes, rows = np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 3))
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, len(means))):
            x, y, z = _to_camera(world_to_cam, means[i])
            drawn = z >= near and opacities[i] >= MIN_ALPHA
            if drawn:
                _turn(quats[i], turn)
                _carry_axes(world_to_cam, turn, scales[i], axes)
                _fill_rows(axes, x, y, z, k, width, height, rows)
                var_x, var_y, slope, rest = _ellipse(rows, low_pass)
                reach = min(math.sqrt(2 * math.log(opacities[i] / MIN_ALPHA)), _MAX_SIGMAS)
                u, v = k[0, 0] * x / z + k[0, 2], k[1, 1] * y / z + k[1, 2]
                far_u = math.ceil(reach * math.sqrt(var_x))
                far_v = math.ceil(reach * math.sqrt(var_y))
                inside = (
                    u + far_u > 0 and u - far_u < width and v + far_v > 0 and v - far_v < height
                )
                drawn = inside and 1 / rest > 0  # no NaN, nothing infinite
            if drawn:
                means2d[i, 0], means2d[i, 1], depths[i] = u, v, z
                shapes[i, 0], shapes[i, 1], shapes[i, 2] = 1 / rest, slope, 1 / var_y
                radii[i, 0], radii[i, 1] = far_u, far_v
            else:
                means2d[i], shapes[i], depths[i], radii[i] = 0, 0, 0, 0


@compiled(parallel=True)
def project_backward(
    means,
    quats,
    scales,
    lens,
    radii,
    means2d_grad,
    shapes_grad,
    depths_grad,
    means_grad,
    quats_grad,
    scales_grad,
    pose_grads,
):
    """Fill the last four: `pose_grads` (blocks 3 4, zeros before) is to be summed over blocks."""
    world_to_cam, k, width, height, _, low_pass = lens
    for block in numba.prange(-(-len(means) // _BLOCK)):
        turn, axes, rows = np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 3))
        axes_grad, rows_grad, turn_grad = np.empty((3, 3)), np.empty((2, 3)), np.empty((3, 3))
        point_grad = np.empty(3)
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, len(means))):
            if not radii[i, 0] > 0:
                means_grad[i], quats_grad[i], scales_grad[i] = 0, 0, 0
                continue
            x, y, z = _to_camera(world_to_cam, means[i])
            _turn(quats[i], turn)
            _carry_axes(world_to_cam, turn, scales[i], axes)
            _fill_rows(axes, x, y, z, k, width, height, rows)
            _ellipse_backward(rows, low_pass, shapes_grad[i], rows_grad)
            _rows_backward(axes, x, y, z, k, width, height, rows, rows_grad, axes_grad, point_grad)
            along_u, along_v = means2d_grad[i, 0] * k[0, 0] / z, means2d_grad[i, 1] * k[1, 1] / z
            point_grad[0] += along_u
            point_grad[1] += along_v
            point_grad[2] += depths_grad[i] - (along_u * x + along_v * y) / z
            pose_grad = pose_grads[block]
            _axes_backward(
                world_to_cam, turn, scales[i], axes_grad, turn_grad, scales_grad[i], pose_grad
            )
            _turn_backward(quats[i], turn_grad, quats_grad[i])
            for column in range(3):
                total = 0.0
                for row in range(3):
                    total += world_to_cam[row, column] * point_grad[row]
                    pose_grad[row, column] += point_grad[row] * means[i, column]
                means_grad[i, column] = total
                pose_grad[column, 3] += point_grad[column]


def pose_blocks(count: int) -> int:
    """How many parts of the pose's gradient `project_backward` fills."""
    return -(-count // _BLOCK)


@compiled()
def _to_camera(world_to_cam, point):
    m, x, y, z = world_to_cam, point[0], point[1], point[2]
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@compiled()
def _unit(quat):
    """The quaternion normalised, and 1 / its length."""
    w, x, y, z = (
        np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    )  # fmt: skip
    inverse = 1 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@compiled()
def _turn(quat, turn):
    """Rotation matrix of a quaternion."""
    w, x, y, z, _ = _unit(quat)
    turn[0, 0], turn[1, 1] = 1 - 2 * (y * y + z * z), 1 - 2 * (x * x + z * z)
    turn[2, 2] = 1 - 2 * (x * x + y * y)
    turn[0, 1], turn[1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    turn[0, 2], turn[2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    turn[1, 2], turn[2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)


@compiled()
def _turn_backward(quat, g, quat_grad):
    w, x, y, z, inverse = _unit(quat)
    along_w = x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1])
    along_x = y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) - 2 * x * (g[1, 1] + g[2, 2])
    along_y = x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) - 2 * y * (g[0, 0] + g[2, 2])
    along_z = x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) - 2 * z * (g[0, 0] + g[1, 1])
    along_x += w * (g[2, 1] - g[1, 2])
    along_y += w * (g[0, 2] - g[2, 0])
    along_z += w * (g[1, 0] - g[0, 1])
    radial = w * along_w + x * along_x + y * along_y + z * along_z
    quat_grad[0] = 2 * inverse * (along_w - w * radial)
    quat_grad[1] = 2 * inverse * (along_x - x * radial)
    quat_grad[2] = 2 * inverse * (along_y - y * radial)
    quat_grad[3] = 2 * inverse * (along_z - z * radial)


@compiled()
def _carry_axes(world_to_cam, turn, scale, axes):
    """The Gaussian's axes in the camera's frame, one a column, as long as its deviations."""
    for row in range(3):
        for axis in range(3):
            total = 0.0
            for j in range(3):
                total += world_to_cam[row, j] * turn[j, axis]
            axes[row, axis] = total * scale[axis]


@compiled()
def _axes_backward(world_to_cam, turn, scale, axes_grad, turn_grad, scale_grad, pose_grad):
    for axis in range(3):
        along = 0.0
        for j in range(3):
            total = 0.0
            for row in range(3):
                total += world_to_cam[row, j] * axes_grad[row, axis]
                pose_grad[row, j] += axes_grad[row, axis] * turn[j, axis] * scale[axis]
            turn_grad[j, axis] = total * scale[axis]
            along += total * turn[j, axis]
        scale_grad[axis] = along


@compiled()
def _slope(ratio, focal, center, size):
    """Clamped x/z (or y/z), and whether the clamp let it be."""
    margin = _VIEW_MARGIN * 0.5 * size / focal
    least, most = -center / focal - margin, (size - center) / focal + margin
    return min(max(ratio, least), most), least <= ratio <= most


@compiled()
def _fill_rows(axes, x, y, z, k, width, height, rows):
    """The axes on the image plane, in px, by the projection's derivative at the mean."""
    slope_x, _ = _slope(x / z, k[0, 0], k[0, 2], width)
    slope_y, _ = _slope(y / z, k[1, 1], k[1, 2], height)
    for axis in range(3):
        rows[0, axis] = (axes[0, axis] - slope_x * axes[2, axis]) * (k[0, 0] / z)
        rows[1, axis] = (axes[1, axis] - slope_y * axes[2, axis]) * (k[1, 1] / z)


@compiled()
def _rows_backward(axes, x, y, z, k, width, height, rows, rows_grad, axes_grad, point_grad):
    slope_x, free_x = _slope(x / z, k[0, 0], k[0, 2], width)
    slope_y, free_y = _slope(y / z, k[1, 1], k[1, 2], height)
    along_x, along_y, shrink = 0.0, 0.0, 0.0
    for axis in range(3):
        axes_grad[0, axis] = rows_grad[0, axis] * k[0, 0] / z
        axes_grad[1, axis] = rows_grad[1, axis] * k[1, 1] / z
        axes_grad[2, axis] = -slope_x * axes_grad[0, axis] - slope_y * axes_grad[1, axis]
        along_x -= axes_grad[0, axis] * axes[2, axis]
        along_y -= axes_grad[1, axis] * axes[2, axis]
        shrink += rows_grad[0, axis] * rows[0, axis] + rows_grad[1, axis] * rows[1, axis]
    point_grad[0] = along_x / z if free_x else 0.0
    point_grad[1] = along_y / z if free_y else 0.0
    point_grad[2] = -(shrink + point_grad[0] * x + point_grad[1] * y) / z


@compiled()
def _ellipse(rows, low_pass):
    """Variances along x and y, slope of the centre line, variance along x within a row of pixels.

    The last is var_x − cov² / var_y, written as a sum of squares: nothing cancels.
    """
    var_x, var_y, cov = low_pass, low_pass, 0.0
    for axis in range(3):
        var_x += rows[0, axis] * rows[0, axis]
        var_y += rows[1, axis] * rows[1, axis]
        cov += rows[0, axis] * rows[1, axis]
    slope = cov / var_y
    rest = low_pass * (1 + slope * slope)
    for axis in range(3):
        apart = rows[0, axis] - slope * rows[1, axis]
        rest += apart * apart
    return var_x, var_y, slope, rest


@compiled()
def _ellipse_backward(rows, low_pass, shape_grad, rows_grad):
    """By shape = (1 / rest, slope, 1 / var_y), `rest` as var_x − cov² / var_y."""
    _, var_y, slope, rest = _ellipse(rows, low_pass)
    rest_grad = -shape_grad[0] / (rest * rest)
    cov_grad = shape_grad[1] / var_y - 2 * slope * rest_grad
    var_y_grad = slope * (slope * rest_grad - shape_grad[1] / var_y) - shape_grad[2] / (
        var_y * var_y
    )
    for axis in range(3):
        rows_grad[0, axis] = 2 * rest_grad * rows[0, axis] + cov_grad * rows[1, axis]
        rows_grad[1, axis] = 2 * var_y_grad * rows[1, axis] + cov_grad * rows[0, axis]
