"""Noise models, plain or wrapped in a robust kernel; the table of kernels."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import gtsam
import numpy as np

from ..config import KernelName, Observing
from ..measurement import Array

SMALLEST_SIGMA, LARGEST_SIGMA = (
    1e-9,
    1e6,
)  # m or rad; outside, a factor breaks the solver without telling it anything


class Kernel(NamedTuple):
    """width: the usual parameter, in standard deviations (95 % efficiency on Gaussian noise where that is defined)."""

    width: float
    make: Callable[[float], Any]


_m = gtsam.noiseModel.mEstimator

KERNELS: Mapping[KernelName, Kernel | None] = {
    "none": None,
    "huber": Kernel(1.345, _m.Huber.Create),  # Huber, 1964
    "cauchy": Kernel(2.3849, _m.Cauchy.Create),
    "tukey": Kernel(4.6851, _m.Tukey.Create),  # Beaton & Tukey, 1974
    "geman_mcclure": Kernel(1.0, _m.GemanMcClure.Create),  # Geman & McClure, 1985
    "dcs": Kernel(1.0, _m.DCS.Create),  # dynamic covariance scaling: Agarwal et al., ICRA 2013
}


def noise_of(covariance: Array, config: Observing | None = None) -> Any:
    """The noise model of a covariance at the factor's tangent; config None: no kernel."""
    if not all(SMALLEST_SIGMA**2 <= each <= LARGEST_SIGMA**2 for each in covariance.diagonal().tolist()):
        variances = np.diag(covariance)
        clipped = np.clip(variances, SMALLEST_SIGMA**2, LARGEST_SIGMA**2)
        scale = np.sqrt(clipped / np.maximum(variances, np.finfo(float).tiny))
        covariance = covariance * scale[:, None] * scale
        np.fill_diagonal(covariance, clipped)  # a variance of zero as well
    return with_kernel(gtsam.noiseModel.Gaussian.Covariance(covariance), config)


def with_kernel(noise: Any, config: Observing | None) -> Any:
    """Wrap a noise model in the kernel that the source asks for."""
    kernel = KERNELS[config.kernel] if config else None
    if kernel is None or config is None:
        return noise
    return gtsam.noiseModel.Robust.Create(kernel.make(config.kernel_width or kernel.width), noise)


def without_kernel(noise: Any) -> Any:
    """The noise model inside a robust one; a plain one as it is."""
    return noise.noise() if isinstance(noise, gtsam.noiseModel.Robust) else noise
