"""Max-mixtures: each loop is its own Gaussian or a null hypothesis, whichever is likelier (Olson & Agarwal, IJRR 2013).

The null hypothesis is a Gaussian about the same place, of `weight` and with `scale` times the information. Its negative
logarithm, and that of the loop's own Gaussian, at a squared Mahalanobis distance chi2, but for a common constant:

    own    chi2 / 2                null    scale chi2 / 2 - ln weight - (d / 2) ln scale

A scale as small as those in use leaves the null hypothesis no pull of its own (1e-12 of the loop's): what remains is the
smaller of chi2 / 2 and a constant, which gtsam has as truncated least squares. The choice is made anew with every linearization.
"""

from functools import partial
from math import log, sqrt

import gtsam

from ..config import Config
from .paths import Paths
from .soft import Soft


class MaxMixture(Soft):
    def __init__(self, config: Config, paths: Paths) -> None:
        bound = null_from(config.max_mixture.weight, config.max_mixture.scale, paths.space.dimension)
        kernel = gtsam.noiseModel.mEstimator.TruncatedLeastSquares.Create(sqrt(bound))
        super().__init__("max_mixture", paths, kernel, partial(own_is_likelier, bound))


def null_from(weight: float, scale: float, dimension: int) -> float:
    """chi2 from which the null hypothesis is the likelier one."""
    return (-2 * log(weight) - dimension * log(scale)) / (1 - scale)


def own_is_likelier(bound: float, chi2: float) -> float:
    return float(chi2 < bound)
