"""Proof by sampling, for everything that carries a covariance."""

import numpy as np
import pytest


@pytest.fixture
def agree():
    """Assert that (N, d) zero-mean errors have the covariance stated: whitened by it they are standard normal.

    Each entry of the sample covariance and of the mean must lie within five standard deviations of its own.
    """

    def check(errors, covariance=None) -> None:
        errors = np.asarray(errors)
        count, dimension = errors.shape
        if covariance is not None:
            errors = np.linalg.solve(np.linalg.cholesky(covariance), errors.T).T
        sample = errors.T @ errors / count
        spread = np.sqrt((1 + np.eye(dimension)) / count)
        np.testing.assert_array_less(np.abs(sample - np.eye(dimension)), 5 * spread)
        np.testing.assert_array_less(np.abs(errors.mean(axis=0)), 5 / np.sqrt(count))

    return check


@pytest.fixture
def spread():
    """A random full covariance, every axis and correlation different: (rng, sigmas) -> (d, d)."""

    def make(rng, sigmas):
        size = len(sigmas)
        turn, _ = np.linalg.qr(rng.normal(size=(size, size)))
        correlation = turn @ np.diag(np.linspace(0.2, 1.8, size)) @ turn.T
        scale = np.sqrt(np.diag(correlation))
        return correlation / scale[:, None] / scale * np.outer(sigmas, sigmas)

    return make
