"""Stacks of 3 x 3 matrices in closed form are what LAPACK makes of each."""

import numpy as np

from slam_backend.core.sensors.symmetric import (
    cholesky,
    full,
    inverse,
    inverse_factor,
    products,
    six_of,
    times,
    transposed_times,
)
from slam_backend.core.sensors.triangulation import whitening

ONES = np.eye(3)


def definite(rng, count: int) -> np.ndarray:
    """Their eigenvalues are up to 1e6 apart."""
    turns, _ = np.linalg.qr(rng.standard_normal((count, 3, 3)))
    return (turns * 10 ** rng.uniform(-3, 3, (count, 1, 3))) @ turns.swapaxes(1, 2)


def lower(six: np.ndarray) -> np.ndarray:
    return np.tril(full(six))


def test_factors_inverses_and_solutions_are_those_of_lapack():
    rng = np.random.default_rng(0)
    matrices, vectors = definite(rng, 200), rng.standard_normal((200, 3))
    factor = cholesky(six_of(matrices))
    np.testing.assert_allclose(lower(factor), np.linalg.cholesky(matrices), rtol=1e-7, atol=1e-9)
    inverted = inverse_factor(factor)
    np.testing.assert_allclose(lower(inverted) @ lower(factor), np.tile(ONES, (200, 1, 1)), atol=1e-9)
    true = np.linalg.inv(matrices)
    size = np.abs(true).max(axis=(1, 2))[:, None, None]
    np.testing.assert_allclose(inverse(six_of(matrices)) / size, true / size, atol=1e-9)
    found = transposed_times(inverted, times(inverted, vectors.T)).T
    np.testing.assert_allclose((matrices @ found[:, :, None])[:, :, 0], vectors, atol=1e-8)


def test_products_of_rows_are_matrix_products():
    rows = np.random.default_rng(1).standard_normal((3, 6, 50))
    each = rows.transpose(2, 0, 1)
    np.testing.assert_allclose(full(products(rows, rows)), each @ each.swapaxes(1, 2), atol=1e-12)


def test_whitening_makes_noise_white_and_mends_what_rounding_broke():
    """W N W^T is the identity; a matrix that is a little indefinite, and one that is not finite, whiten finitely."""
    rng = np.random.default_rng(2)
    noise, sigmas = definite(rng, 30), rng.uniform(0.3, 2.0, 30)
    found = lower(whitening(six_of(noise), sigmas))
    whole = noise + ONES * (sigmas**2)[:, None, None]
    np.testing.assert_allclose(found @ whole @ found.swapaxes(1, 2), np.tile(ONES, (30, 1, 1)), atol=1e-9)
    broken = np.stack([np.diag([4.0, 1.0, -10.0]), np.full((3, 3), np.nan)])
    mended = lower(whitening(six_of(broken), np.ones(2)))
    np.testing.assert_allclose(mended[0], np.diag([1 / np.sqrt(5.0), 1 / np.sqrt(2.0), 1.0]), atol=1e-9)
    np.testing.assert_allclose(mended[1], ONES, atol=1e-12)
