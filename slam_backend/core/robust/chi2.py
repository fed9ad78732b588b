"""Chi-square: how large a squared Mahalanobis distance may be by chance."""

from functools import cache
from math import erf, exp, inf, lgamma, log, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray


def chi2_below(value: float, dof: int) -> float:
    """Probability that a chi-square variable with so many degrees of freedom is below a value (Abramowitz & Stegun, 26.4)."""
    half = value / 2
    found, n = (erf(sqrt(half)), 1) if dof % 2 else (1 - exp(-half), 2)
    while n < dof:
        found -= exp(n / 2 * log(half) - half - lgamma(n / 2 + 1)) if half > 0 else 0.0
        n += 2
    return found


@cache
def chi2_quantile(probability: float, dof: int) -> float:
    """The value below which such a variable lies with a probability in (0, 1)."""
    low, high = 0.0, 1.0
    while chi2_below(high, dof) < probability:
        high *= 2
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if chi2_below(middle, dof) < probability else (low, middle)
    return high


def chi2_limits(probability: float, dofs: ArrayLike) -> NDArray[np.float64]:
    """`chi2_quantile` of each; infinite for a probability of 1."""
    each = np.asarray(dofs).astype(int)
    found = np.full(each.shape, inf)
    if probability < 1:
        for dof in np.unique(each):
            found[each == dof] = chi2_quantile(probability, int(dof)) if dof > 0 else 0.0
    return found
