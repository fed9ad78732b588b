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
    away = np.linalg.norm((found.antennas - found.fixes)[:, :2], axis=1)
    known = np.isfinite(away)
    if not known.any():
        raise BadFile(f"{run}: does not know where it lies on the earth: its summary.json says why")
    errors = {"withheld": away[known & found.withheld], "used": away[known & ~found.withheld]}
    if found.withheld.any() and not found.withheld.all():
        errors["interpolated"] = _by_lines(found)[known & found.withheld]
    return {name: _statistics(each) for name, each in errors.items() if len(each)}


def _by_lines(found: Compared) -> Array:
    used = np.flatnonzero(~found.withheld)
    used = used[np.argsort(found.stamps[used], kind="stable")]
    drawn = [np.interp(found.stamps, found.stamps[used], found.fixes[used, axis]) for axis in (0, 1)]
    return np.asarray(np.hypot(drawn[0] - found.fixes[:, 0], drawn[1] - found.fixes[:, 1]))


def _statistics(errors: Array) -> dict[str, float]:
    return {
        "count": float(len(errors)),
        "rmse": float(np.sqrt(np.mean(errors**2))),
        "median": float(np.median(errors)),
        "max": float(errors.max()),
    }
