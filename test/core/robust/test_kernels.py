"""Kernels are the textbook's; a noise model never lets an absurd sigma through."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest

from slam_backend.core.config import LandmarkSource, RelativeSource
from slam_backend.core.robust.kernels import (
    KERNELS,
    LARGEST_SIGMA,
    SMALLEST_SIGMA,
    noise_of,
    with_kernel,
    without_kernel,
)

ERRORS = np.array([0.01, 0.3, 0.9, 1.0, 1.4, 3.0, 10.0])
UNIT = gtsam.noiseModel.Isotropic.Sigma(1, 1.0)


def textbook(name, c, e) -> tuple[float, float]:
    """Loss and weight at a residual of e standard deviations (Zhang 1997; DCS: MacTavish & Barfoot 2015)."""
    s = e * e
    if name == "huber":
        return (s / 2, 1.0) if e <= c else (c * (e - c / 2), c / e)
    if name == "cauchy":
        return c * c / 2 * np.log(1 + s / (c * c)), 1 / (1 + s / (c * c))
    if name == "tukey":
        inside = 1 - s / (c * c)
        return (c * c / 6 * (1 - inside**3), inside**2) if e <= c else (c * c / 6, 0.0)
    if name == "geman_mcclure":
        return c * c * s / (2 * (c * c + s)), (c * c / (c * c + s)) ** 2
    return (s / 2, 1.0) if s <= c else (2 * c * s / (c + s) - c / 2, (2 * c / (c + s)) ** 2)


@pytest.mark.parametrize("width", [None, 0.8, 2.0])
@pytest.mark.parametrize("name", [name for name in KERNELS if name != "none"])
def test_loss_and_weight_are_those_of_the_textbook(name, width):
    noise = with_kernel(UNIT, RelativeSource(kernel=name, kernel_width=width))
    kernel = noise.robust()
    c = width or KERNELS[name].width
    for error in ERRORS:
        loss, weight = textbook(name, c, error)
        assert kernel.loss(error) == pytest.approx(loss, rel=1e-9), (name, error)
        assert kernel.weight(error) == pytest.approx(weight, rel=1e-9, abs=1e-15), (name, error)


@pytest.mark.parametrize("name", KERNELS)
def test_small_errors_are_left_alone_and_large_ones_never_gain(name):
    noise = with_kernel(UNIT, RelativeSource(kernel=name))
    if name == "none":
        assert noise is UNIT
        return
    weights = [noise.robust().weight(error) for error in ERRORS]
    assert weights[0] == pytest.approx(1.0, abs=1e-3)
    assert all(later <= earlier for earlier, later in pairwise(weights))


def covariance_of(noise) -> np.ndarray:
    return np.asarray(noise.covariance())


def test_without_a_kernel_the_noise_is_plain():
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    for config in (None, LandmarkSource()):
        noise = noise_of(covariance, config)
        assert not isinstance(noise, gtsam.noiseModel.Robust)
        np.testing.assert_allclose(covariance_of(noise), covariance, rtol=1e-12)
    robust = noise_of(covariance, LandmarkSource(kernel="huber"))
    np.testing.assert_allclose(covariance_of(robust.noise()), covariance, rtol=1e-12)


@pytest.mark.parametrize("absurd", [1e-300, 1e-30, 1e13, 1e300])
def test_absurd_sigmas_are_clipped_and_correlations_kept(absurd):
    sigmas = np.array([np.sqrt(absurd), 2.0, 3.0])
    correlation = np.array([[1.0, 0.5, 0.1], [0.5, 1.0, -0.3], [0.1, -0.3, 1.0]])
    noise = noise_of(correlation * np.outer(sigmas, sigmas))
    got = np.sqrt(np.diag(covariance_of(noise)))
    expected = SMALLEST_SIGMA if absurd < 1 else LARGEST_SIGMA
    np.testing.assert_allclose(got, [expected, 2.0, 3.0], rtol=1e-4)
    np.testing.assert_allclose(covariance_of(noise) / np.outer(got, got), correlation, atol=1e-4)
    assert np.isfinite(noise.R()).all()


@pytest.mark.parametrize("sigmas", [(0.0, 1.0), (0.0, 0.0)])
def test_a_variance_of_zero_becomes_the_smallest(sigmas):
    noise = noise_of(np.diag(np.square(sigmas)))
    assert np.isfinite(noise.R()).all()
    np.testing.assert_allclose(
        np.diag(covariance_of(noise)), np.maximum(sigmas, SMALLEST_SIGMA) ** 2, rtol=1e-6
    )


def test_a_kernel_can_be_taken_off_again():
    assert without_kernel(UNIT) is UNIT
    assert not isinstance(
        without_kernel(with_kernel(UNIT, RelativeSource(kernel="dcs"))), gtsam.noiseModel.Robust
    )
