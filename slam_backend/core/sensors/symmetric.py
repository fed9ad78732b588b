"""Hundreds of symmetric 3 x 3 matrices at once, in closed form: numpy's own solvers call LAPACK for each of a stack, which is
nearly all overhead at that size.

A stack is (6, N): the elements 00 10 11 20 21 22 of N matrices; of a triangular factor likewise.
"""

import numpy as np

from ..measurement import Array

ROWS, COLUMNS = [0, 1, 1, 2, 2, 2], [0, 0, 1, 0, 1, 2]
DIAGONAL = [0, 2, 5]


def products(first: Array, second: Array) -> Array:
    """(6, N) sums over the middle axis of (3, K, N) rows times (3, K, N) rows, where these are symmetric."""
    return np.asarray((first[ROWS] * second[COLUMNS]).sum(axis=1))


def cholesky(a: Array) -> Array:
    """(6, N) lower factors; NaN where a matrix is not positive definite."""
    with np.errstate(all="ignore"):
        l00 = np.sqrt(a[0])
        l10, l20 = a[1] / l00, a[3] / l00
        l11 = np.sqrt(a[2] - l10 * l10)
        l21 = (a[4] - l20 * l10) / l11
        l22 = np.sqrt(a[5] - l20 * l20 - l21 * l21)
    return np.array([l00, l10, l11, l20, l21, l22])


def inverse_factor(factor: Array) -> Array:
    """(6, N) inverses of lower factors."""
    l00, l10, l11, l20, l21, l22 = factor
    with np.errstate(all="ignore"):
        w00, w11, w22 = 1 / l00, 1 / l11, 1 / l22
        w10, w21 = -l10 * w00 * w11, -l21 * w11 * w22
        w20 = -(l20 * w00 + l21 * w10) * w22
    return np.array([w00, w10, w11, w20, w21, w22])


def times(lower: Array, rows: Array) -> Array:
    """(3, ..., N) lower factors (6, N) times three rows."""
    first, second, third = rows
    return np.array(
        [
            lower[0] * first,
            lower[1] * first + lower[2] * second,
            lower[3] * first + lower[4] * second + lower[5] * third,
        ]
    )


def transposed_times(lower: Array, rows: Array) -> Array:
    """(3, ..., N) transposed lower factors (6, N) times three rows."""
    first, second, third = rows
    return np.array(
        [
            lower[0] * first + lower[1] * second + lower[3] * third,
            lower[2] * second + lower[4] * third,
            lower[5] * third,
        ]
    )


def inverse(a: Array) -> Array:
    """(N, 3, 3) inverses, in full."""
    lower = inverse_factor(cholesky(a))
    w00, w10, w11, w20, w21, w22 = lower
    six = np.array(
        [
            w00 * w00 + w10 * w10 + w20 * w20,
            w10 * w11 + w20 * w21,
            w11 * w11 + w21 * w21,
            w20 * w22,
            w21 * w22,
            w22 * w22,
        ]
    )
    return full(six)


def full(six: Array) -> Array:
    """(N, 3, 3)."""
    return np.ascontiguousarray(six[[0, 1, 3, 1, 2, 4, 3, 4, 5]].T).reshape(-1, 3, 3)


def six_of(matrices: Array) -> Array:
    """(6, N) of (N, 3, 3), their lower triangles."""
    return np.ascontiguousarray(matrices[:, ROWS, COLUMNS].T)
