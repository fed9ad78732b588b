"""Poses and covariances as arrays, and the one place where ROS order becomes GTSAM order.

Derivation: with a small error in ROS's convention, `a_T_b` moves to `(R exp(..), p + dp)` where `dp` and the
rotation `dr` are along the axes of a. GTSAM perturbs on the right, `a_T_b Exp(w, v)`: the same error is
`w = R^T dr`, `v = R^T dp`, hence `cov_gtsam = A cov_ros A^T` with `A = [[0, R^T], [R^T, 0]]`.
"""

import numpy as np
from numpy.typing import ArrayLike

from .measurement import Array


def rotation_of(quaternions: ArrayLike) -> Array:
    """(..., 4) qx qy qz qw, of any length but zero, to (..., 3, 3)."""
    q = np.asarray(quaternions, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(q, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_of(rotations: ArrayLike) -> Array:
    """(..., 3, 3) to (..., 4) qx qy qz qw with qw >= 0. (Largest of the four candidates: Shepperd 1978.)"""
    m = np.asarray(rotations, dtype=np.float64)
    shape, m = m.shape[:-2], m.reshape(-1, 3, 3)
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    squares = np.stack([1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz], axis=1)
    products = {
        (0, 1): m[:, 0, 1] + m[:, 1, 0], (0, 2): m[:, 0, 2] + m[:, 2, 0], (1, 2): m[:, 1, 2] + m[:, 2, 1],
        (0, 3): m[:, 2, 1] - m[:, 1, 2], (1, 3): m[:, 0, 2] - m[:, 2, 0], (2, 3): m[:, 1, 0] - m[:, 0, 1],
    }  # fmt: skip
    table = np.zeros((len(m), 4, 4))
    for i in range(4):
        table[:, i, i] = squares[:, i]
    for (i, j), value in products.items():
        table[:, i, j] = table[:, j, i] = value
    q = table[np.arange(len(m)), squares.argmax(axis=1)]
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    q[q[:, 3] < 0] *= -1
    return np.asarray(q.reshape(*shape, 4))


def matrix_of(sevens: ArrayLike) -> Array:
    """(..., 7) x y z qx qy qz qw to (..., 4, 4)."""
    seven = np.asarray(sevens, dtype=np.float64)
    matrix = np.zeros((*seven.shape[:-1], 4, 4))
    matrix[..., :3, :3] = rotation_of(seven[..., 3:])
    matrix[..., :3, 3] = seven[..., :3]
    matrix[..., 3, 3] = 1
    return matrix


def seven_of_matrix(matrices: ArrayLike) -> Array:
    """(..., 4, 4) to (..., 7) x y z qx qy qz qw."""
    m = np.asarray(matrices, dtype=np.float64)
    return np.concatenate([m[..., :3, 3], quaternion_of(m[..., :3, :3])], axis=-1)


def inverse_of(matrices: ArrayLike) -> Array:
    """Inverse of (..., 4, 4) rigid transforms."""
    m = np.asarray(matrices, dtype=np.float64)
    inverse = np.zeros_like(m)
    transposed = np.swapaxes(m[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = transposed
    inverse[..., :3, 3] = -(transposed @ m[..., :3, 3, None])[..., 0]
    inverse[..., 3, 3] = 1
    return inverse


def covariance_from_ros(covariance: ArrayLike, rotation: ArrayLike) -> Array:
    """(..., 6, 6) in ROS order and parent axes, of a pose with (..., 3, 3) rotation, to GTSAM's order and tangent."""
    a = _ros_to_gtsam(rotation)
    return np.asarray(a @ np.asarray(covariance, dtype=np.float64) @ np.swapaxes(a, -1, -2))


def covariance_to_ros(covariance: ArrayLike, rotation: ArrayLike) -> Array:
    """The inverse of `covariance_from_ros`."""
    a = np.swapaxes(_ros_to_gtsam(rotation), -1, -2)  # A is orthogonal
    return np.asarray(a @ np.asarray(covariance, dtype=np.float64) @ np.swapaxes(a, -1, -2))


def _ros_to_gtsam(rotation: ArrayLike) -> Array:
    transposed = np.swapaxes(np.asarray(rotation, dtype=np.float64), -1, -2)
    a = np.zeros((*transposed.shape[:-2], 6, 6))
    a[..., :3, 3:] = transposed
    a[..., 3:, :3] = transposed
    return a
