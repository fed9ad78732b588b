"""Where the robot is between two answers of the solver: the newest correction and the odometry since."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..core.backend import Update
from ..core.check import pace_of
from ..core.config import Config, OdometrySource
from ..core.graph import Motion
from ..core.keyframes import growth
from ..core.measurement import SECOND, Array, frozen
from ..core.sensors.odometry import OdometryPose
from ..core.space import SPACES

FRESH = (
    SECOND // 50
)  # ns for which a covariance serves again: it changes slowly, and costs more than the pose


# A covariance that is not determined: a kilometre and more than a full turn, rather than zeros that look certain.
UNKNOWN = frozen(np.diag([1e6] * 6).ravel())


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """`map_T_base`, its covariance (36, ROS order; UNKNOWN where it is not determined), and `map_T_odom`."""

    seven: tuple[float, ...]
    covariance: Array
    correction: tuple[float, ...]


class Odometer:
    """Of the driving odometry, in the order of its stamps."""

    def __init__(self, config: Config) -> None:
        self._space = SPACES[config.space]
        self._last = 0
        self._covariance: tuple[Update, int, Array] | None = None
        driving = config.sources.get(config.driver) if config.driver else None
        self._noise = driving if isinstance(driving, OdometrySource) else OdometrySource()
        self._pace = pace_of(config.driver or "", config)
        self._good: OdometryPose | None = None  # the newest that follows what the worker believes

    def goes_on(self, stamp: int) -> bool:
        """Whether this stamp (ns) is newer than all that were told so."""
        new = stamp > self._last
        self._last = max(self._last, stamp)
        return new

    def locate(
        self, odometry: OdometryPose, update: Update | None, covariance: Sequence[float] | None
    ) -> Located | None:
        """None before the first update, and where the odometry jumps, until the worker has found out what that was."""
        if update is None or not self._follows(odometry, update):
            return None
        correction = composed(update.correction, update.origin)
        seven = composed(correction, odometry.pose.tolist())
        return Located(seven, self._spread(odometry, seven, update, covariance), correction)

    def _follows(self, odometry: OdometryPose, update: Update) -> bool:
        last = self._good
        follows = (
            last is None
            or self._pace.breach(last, odometry) is None
            or update.keyframe.stamp > last.stamp  # a restart begins with a keyframe
        )
        if follows:
            self._good = odometry
        return follows

    def _spread(
        self,
        odometry: OdometryPose,
        seven: Sequence[float],
        update: Update,
        covariance: Sequence[float] | None,
    ) -> Array:
        """The keyframe's marginal, and the odometry's noise since, seen from here."""
        if covariance is None:
            return UNKNOWN
        kept = self._covariance
        if kept is not None and kept[0] is update and abs(odometry.stamp - kept[1]) < FRESH:
            return kept[2]
        space = self._space
        there = space.pose(update.pose)
        marginal = np.reshape(covariance, (6, 6))
        at_keyframe = Motion(there, space.covariance(marginal, there))
        here = space.pose(seven)
        since = there.between(here)
        total = at_keyframe.then(Motion(since, growth(space, self._noise, since)))
        ros = space.covariance_to_ros(total.covariance, here).reshape(36)
        self._covariance = (update, odometry.stamp, ros)
        return ros


def composed(a: Sequence[float], b: Sequence[float]) -> tuple[float, ...]:
    """`x_T_z` from `x_T_y` and `y_T_z`, both x y z qx qy qz qw; in plain floats, since it runs at odometry rate."""
    ax, ay, az, aqx, aqy, aqz, aqw = a
    bx, by, bz, bqx, bqy, bqz, bqw = b
    tx = 2 * (aqy * bz - aqz * by)
    ty = 2 * (aqz * bx - aqx * bz)
    tz = 2 * (aqx * by - aqy * bx)
    return (
        ax + bx + aqw * tx + aqy * tz - aqz * ty,
        ay + by + aqw * ty + aqz * tx - aqx * tz,
        az + bz + aqw * tz + aqx * ty - aqy * tx,
        aqw * bqx + aqx * bqw + aqy * bqz - aqz * bqy,
        aqw * bqy - aqx * bqz + aqy * bqw + aqz * bqx,
        aqw * bqz + aqx * bqy - aqy * bqx + aqz * bqw,
        aqw * bqw - aqx * bqx - aqy * bqy - aqz * bqz,
    )
