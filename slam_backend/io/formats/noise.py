"""Information and covariance matrices as files state them: the upper triangle, in each format's own order."""

import numpy as np

from ...core.measurement import Array

Pairs = tuple[tuple[int, int], ...]  # (row, column) of each number of a line


def _rows(size: int, shift: int = 0) -> Pairs:
    """Upper triangle row by row; `shift` moves axis k of the file to axis k + shift of ours."""
    return tuple(
        ((row + shift) % size, (column + shift) % size) for row in range(size) for column in range(row, size)
    )


SCALAR = _rows(1)
XY = _rows(2)
XYZ = _rows(3)
SE2 = _rows(3)  # x y theta
SE2_TORO: Pairs = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))
SE3 = _rows(6, shift=3)  # files have translation first, GTSAM has rotation first

HALF_ANGLE = np.array([0.5, 0.5, 0.5, 1.0, 1.0, 1.0])
"""g2o measures rotation by the quaternion's vector part, half the angle: its information times the outer product of this
is the information of the angle. All factors are powers of two, so that no bit is lost in either direction."""


def unfold(upper: Array, pairs: Pairs) -> Array:
    """(M, n) numbers to (M, d, d) symmetric matrices."""
    rows, columns = np.array(pairs).T
    size = int(rows.max()) + 1
    matrices = np.zeros((len(upper), size, size))
    matrices[:, rows, columns] = upper
    matrices[:, columns, rows] = upper
    return matrices


def fold(matrices: Array, pairs: Pairs) -> Array:
    """The inverse of `unfold`."""
    rows, columns = np.array(pairs).T
    return np.asarray(matrices[:, rows, columns])


def turned(matrices: Array, rotations: Array) -> Array:
    """R^T M R, symmetric to the bit: (M, d, d) information along the axes that R, (M, d, d), has in those of before."""
    with np.errstate(all="ignore"):
        result = (
            np.swapaxes(rotations, 1, 2) @ (matrices / 2) @ rotations
        )  # halves, so that their sum cannot overflow
        return np.asarray(result + np.swapaxes(result, 1, 2))


def least_correlation(matrices: Array) -> Array:
    """(M,) the smallest eigenvalue of each matrix after scaling its diagonal to one; negative: indefinite.

    Axes of metres and radians differ by orders of magnitude; the scaling makes one tolerance serve all. An axis
    whose diagonal is zero must be zero throughout, a negative diagonal is indefinite.
    """
    diagonal = np.diagonal(matrices, axis1=1, axis2=2)
    with np.errstate(all="ignore"):
        scale = np.where(diagonal > 0, 1 / np.sqrt(np.abs(diagonal)), 1)
        scaled = matrices * scale[:, :, None] * scale[:, None, :]
    usable = np.isfinite(scaled).all(axis=(1, 2)) & (diagonal >= 0).all(axis=1)
    least = np.full(len(matrices), -np.inf)
    least[usable] = np.linalg.eigvalsh(scaled[usable]).min(axis=1, initial=1)
    return least


def inverse(matrices: Array) -> Array:
    """Inverses of positive definite (M, d, d), symmetric to the bit; not finite where there is none."""
    diagonal = np.diagonal(matrices, axis1=1, axis2=2)
    with np.errstate(all="ignore"):
        scale = 1 / np.sqrt(diagonal)
        outer = scale[:, :, None] * scale[:, None, :]
        scaled = matrices * outer
        good = np.isfinite(scaled).all(axis=(1, 2)) & (least_correlation(matrices) > 1e-12)
        result = np.full(matrices.shape, np.nan)
        result[good] = np.linalg.inv(scaled[good]) * outer[good]
        return np.asarray(result / 2 + np.swapaxes(result, 1, 2) / 2)
