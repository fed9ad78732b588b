"""Chi-square: how large a squared Mahalanobis distance may be by chance."""

from functools import cache
from math import erf, exp, lgamma, log, sqrt


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
