"""What is wrong with an IMU: by the looks of its samples, and beside the odometry."""

from collections.abc import Sequence

import numpy as np

from .config import ImuSource
from .measurement import SECOND, Array, ImuSample

STUCK = SECOND  # ns of the very same numbers that no IMU tells by itself: a real one has noise
STRAIGHT = 1e-3  # relative change of a slope that is only rounding
TURN, TURNS = 0.05, 10  # rad by the odometry that count as a turn; turns that fit until no more are looked at
DEGREES = 20.0  # times as far as the odometry: 57 are expected of rates in degrees per second


class Symptoms:
    """in_degrees: the last turn by the gyroscope was tens of times that by the odometry."""

    def __init__(self, config: ImuSource) -> None:
        self._config, self._longest = config, config.max_gap * SECOND
        self._ends = config.max_rate is not None or config.max_acceleration is not None
        self._up, self._slope = 0.0, 0.0  # vertical acceleration of the newest sample; its change per ns
        self._straight = 0  # ns for which that has been the same, and not zero: somebody filled a gap
        self._same: int | None = 0  # ns for which nothing has changed; None once that has been told
        self.in_degrees, self._fitting = False, 0  # turns in a row that have fitted

    def compare(self, sample: ImuSample, before: ImuSample) -> float | None:
        """With the one before it. Seconds for which the IMU has been stuck, told once; else None."""
        elapsed, last, up = sample.stamp - before.stamp, self._slope, sample.acceleration.item(2)
        self._slope = slope = (up - self._up) / elapsed if elapsed > 0 else 0.0
        self._up = up
        on = slope != 0 and abs(slope - last) <= STRAIGHT * abs(slope)
        self._straight = self._straight + elapsed if on else 0
        if self._same is None:
            return None
        stuck = slope == 0 and elapsed > 0 and _are_alike(sample, before)
        same = self._same + elapsed if stuck else 0
        self._same = None if same > STUCK else same
        return same / SECOND if same > STUCK else None

    def flaw(self, sample: ImuSample) -> str:
        """The rule by which the stretch that it belongs to must not be used; empty if it may."""
        if self._straight > self._longest:
            return "imu/interpolated"
        return "imu/saturated" if self._ends and self._is_saturated(sample) else ""

    @property
    def doubts_turns(self) -> bool:
        """Whether enough turns have not fitted yet."""
        return self._fitting < TURNS

    def compare_turns(self, rates: Sequence[Array], seconds: float, turned: float) -> None:
        """A stretch with the odometry. Rates in degrees per second show where the robot turns. turned: rad by the odometry."""
        if turned >= TURN and rates:
            by_gyroscope = float(np.linalg.norm(np.mean(rates, axis=0))) * seconds
            self.in_degrees = by_gyroscope > DEGREES * turned
            self._fitting = 0 if self.in_degrees else self._fitting + 1

    def _is_saturated(self, sample: ImuSample) -> bool:
        rate, acceleration = self._config.max_rate, self._config.max_acceleration
        return (rate is not None and max(map(abs, sample.rate.tolist())) >= rate) or (
            acceleration is not None and max(map(abs, sample.acceleration.tolist())) >= acceleration
        )


def _are_alike(one: ImuSample, other: ImuSample) -> bool:
    """Whether all six numbers are the same, to the last bit."""
    return np.array_equal(one.acceleration, other.acceleration) and np.array_equal(one.rate, other.rate)
