"""How each source does, as far as the estimate can tell: numbers and words by name, one form for all kinds. For diagnostics.

in_graph            factors that rest on it now
of fixes
told, withheld      fixes that came, and those that the configuration keeps back
status              of the newest: fix, sbas (augmented by satellites), gbas (by stations on the ground)
since_s             from the newest fix to the newest keyframe
yaw                 observable, or why it is not yet; sigma_yaw_rad
of an IMU
bias_accelerometer  x y z (m/s^2, in the IMU's frame) at the newest keyframe, bias_gyroscope (rad/s), and their sigmas
"""

from collections import Counter
from collections.abc import Mapping

import numpy as np

from .books import Books
from .errors import SlamError
from .fixes import Tally
from .georeference import Georeference
from .graph import Keyframe
from .measurement import SECOND, Array
from .sensors.imu import bias_key

Condition = Mapping[str, str]
STATUS = ("fix", "sbas", "gbas")  # of NavSatStatus, from 0 on


def conditions(books: Books, earth: Georeference | None) -> dict[str, Condition]:
    """By source. Costs time in proportion to the graph."""
    counts = Counter(factor.source for factor in books.solver.factors.values())
    found: dict[str, Condition] = {}
    for name, source in books.config.sources.items():
        told = {"in_graph": str(counts[name])}
        if source.kind == "gnss":
            told |= _of_fixes(books.fixes.tally(name), books.timeline.newest, earth)
        elif name == books.imu:
            told |= _of_imu(books)
        found[name] = told
    return found


def _of_fixes(tally: Tally, newest: Keyframe | None, earth: Georeference | None) -> Condition:
    told = {"told": str(tally.told), "withheld": str(tally.withheld)}
    if tally.told and newest:
        told["status"] = STATUS[tally.status] if 0 <= tally.status < len(STATUS) else str(tally.status)
        told["since_s"] = f"{max(newest.stamp - tally.newest, 0) / SECOND:.2f}"
    if earth is not None:
        told["yaw"] = earth.why if earth.pose is None else "observable"
        if earth.sigma_yaw is not None:
            told["sigma_yaw_rad"] = f"{earth.sigma_yaw:.4f}"
    return told


def _of_imu(books: Books) -> Condition:
    newest = books.timeline.newest
    if newest is None or not books.estimate.knows(key := bias_key(newest)):
        return {}
    bias = books.estimate.value(key).vector()
    told = {"bias_accelerometer": _numbers(bias[:3]), "bias_gyroscope": _numbers(bias[3:])}
    try:
        sigmas = np.sqrt(np.diag(books.estimate.covariance([key])))
    except SlamError:
        return told
    return told | {
        "sigma_bias_accelerometer": _numbers(sigmas[:3]),
        "sigma_bias_gyroscope": _numbers(sigmas[3:]),
    }


def _numbers(values: Array) -> str:
    return " ".join(f"{x:.3g}" for x in values.tolist())
