"""Fixes as a truth: how far a run is from those that were kept back, beside straight lines between the others."""

from pathlib import Path

import numpy as np

from ..core.errors import BadFile
from ..core.fixes import Compared
from ..core.measurement import Array
from ..io.earth import NAME, read_fixes

Errors = dict[str, dict[str, float]]  # of whom -> count, rmse, median, max; m, horizontally


def evaluate_fixes(run: Path) -> Errors:
    """`withheld`, `used`, and `interpolated`: straight lines across what was withheld. BadFile for a run without fixes, or without a
    place on the earth.
    """
    found = read_fixes(run / NAME)
    apart = away(found)
    known = np.isfinite(apart)
    if not known.any():
        raise BadFile(f"{run}: does not know where it lies on the earth: its summary.json says why")
    errors = {"withheld": apart[known & found.withheld], "used": apart[known & ~found.withheld]}
    if found.withheld.any() and not found.withheld.all():
        errors["interpolated"] = away_by_lines(found)[known & found.withheld]
    return {name: _statistics(each) for name, each in errors.items() if len(each)}


def away(found: Compared) -> Array:
    """(N,) m horizontally from each fix to where its antenna is believed to have been."""
    return np.asarray(np.linalg.norm((found.antennas - found.fixes)[:, :2], axis=1))


def away_by_lines(found: Compared) -> Array:
    """(N,) the same of straight lines between the fixes that are not kept back."""
    used = np.flatnonzero(~found.withheld)
    used = used[np.argsort(found.stamps[used], kind="stable")]
    drawn = [np.interp(found.stamps, found.stamps[used], found.fixes[used, axis]) for axis in (0, 1)]
    return np.asarray(np.hypot(drawn[0] - found.fixes[:, 0], drawn[1] - found.fixes[:, 1]))


def rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def _statistics(errors: Array) -> dict[str, float]:
    return {
        "count": float(len(errors)),
        "rmse": rms(errors),
        "median": float(np.median(errors)),
        "max": float(errors.max()),
    }
