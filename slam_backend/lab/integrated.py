"""Speed and yaw rate, each row held until the next one, as the odometry of a planar robot."""

from dataclasses import dataclass

import numpy as np

from ..core.geometry import seven_of_matrix
from ..core.measurement import SECOND, Array
from ..core.sensors.odometry import UNKNOWN
from ..io.encode import encode_odometry
from ..io.formats.lines import Stamps
from ..io.records import Record
from .simulate import ODOMETRY
from .world import chain, exp_of

BASE = "base_link"


@dataclass(frozen=True, slots=True, eq=False)
class Rates:
    """stamps: (N,) ns. speed: (N,) m/s ahead. turning: (N,) rad/s to the left."""

    stamps: Stamps
    speed: Array
    turning: Array


def integrated(rates: Rates) -> Array:
    """(N, 7) poses at the stamps, along arcs, from the origin."""
    seconds = np.diff(rates.stamps) / SECOND
    tangents = np.zeros((len(seconds), 6))
    tangents[:, 3], tangents[:, 2] = rates.speed[:-1] * seconds, rates.turning[:-1] * seconds
    return seven_of_matrix(chain(exp_of(tangents)))


def odometry_records(rates: Rates, sevens: Array) -> list[Record]:
    """On /odom; no covariance is known."""
    twists = np.zeros((len(sevens), 6))
    twists[:, 0], twists[:, 5] = rates.speed, rates.turning
    return [
        Record("/odom", ODOMETRY, stamp, encode_odometry(stamp, "odom", BASE, seven, UNKNOWN, twist, UNKNOWN))
        for stamp, seven, twist in zip(rates.stamps.tolist(), sevens, twists, strict=True)
    ]
