"""How far from fixes of GNSS an estimate lies, and straight lines between those that it knew."""

import numpy as np

from slam_backend.core.fixes import Compared
from slam_backend.core.measurement import Array


def away(found: Compared) -> Array:
    """(N,) m horizontally from each fix to where its antenna is believed to have been."""
    return np.asarray(np.linalg.norm((found.antennas - found.fixes)[:, :2], axis=1))


def away_by_lines(found: Compared) -> Array:
    """(N,) the same of straight lines between the fixes that are not kept back."""
    used = ~found.withheld
    drawn = [np.interp(found.stamps, found.stamps[used], found.fixes[used, axis]) for axis in (0, 1)]
    return np.asarray(np.hypot(drawn[0] - found.fixes[:, 0], drawn[1] - found.fixes[:, 1]))


def rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2)))
