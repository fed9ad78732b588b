"""Odometry in order: each message against the one before it, and against the one that follows."""

from collections.abc import Iterator
from dataclasses import replace
from math import dist, inf
from typing import NamedTuple

import numpy as np

from ..geometry import covariance_from_ros, covariance_to_ros, inverse_of, matrix_of, seven_of_matrix
from ..graph import Decision
from ..measurement import SECOND, Array, Measurement, frozen
from ..sensors.odometry import OdometryPose
from ..space import SPACES, Space
from .rules import JITTER, decided


class Breach(NamedTuple):
    """Why one message cannot follow another: the rule, and the numbers of its decision."""

    rule: str
    statistic: float | None = None
    threshold: float | None = None


class Pace:
    """Whether one message of an odometry source can follow another: from the same frames, and not too far for the time between."""

    def __init__(self, max_speed: float, space: Space) -> None:
        """max_speed: m/s."""
        self.max_speed, self._dimension = max_speed, space.point_dimension

    def breach(self, last: Measurement, item: Measurement) -> Breach | None:
        """last: the earlier one. What is no odometry has no pace."""
        if not isinstance(last, OdometryPose) or not isinstance(item, OdometryPose):
            return None
        if last.frame != item.frame or last.child != item.child:
            return Breach("recheck/frame_changed")
        n = self._dimension
        meters = dist(last.pose.tolist()[:n], item.pose.tolist()[:n])
        seconds = (item.stamp - last.stamp) / SECOND
        if meters <= self.max_speed * seconds + JITTER:
            return None
        return Breach("recheck/teleport", meters / seconds, self.max_speed)


UNBOUND = Pace(inf, SPACES["3d"])


class Continuity:
    """Of one odometry source: the last message believed, and a doubtful one that waits for the next.

    A jump, or another frame, that the next message confirms is a restart: the odometry's frame moved, the robot did not. From
    then on its poses are shifted so that the track goes on where it was.
    """

    def __init__(self, pace: Pace, space: Space) -> None:
        self._pace, self._space = pace, space
        self._unused = [axis for axis in range(6) if axis not in space.used]
        self._last: OdometryPose | None = None
        self._doubt: OdometryPose | None = None
        self._breach = Breach("")  # of the doubtful one
        self._shift: Array | None = None  # (4, 4), old frame from new frame

    def judge(self, item: OdometryPose) -> Iterator[Measurement | Decision]:
        last, doubt = self._last, self._doubt
        if last is not None and item.stamp <= last.stamp:
            yield decided(item, "refused", "recheck/duplicate")
        elif last is None or (breach := self._pace.breach(last, item)) is None:
            if doubt is not None:
                yield from self.drop_doubt()
            self._last = item
            yield self._shifted(item)
        elif doubt is not None and item.stamp == doubt.stamp:  # no witness: it may be the same message again
            yield decided(item, "refused", "recheck/duplicate")
        elif doubt is None or self._pace.breach(doubt, item) is not None:
            yield from self.drop_doubt()
            self._doubt, self._breach = item, breach
        else:
            speed = self._breach.statistic
            yield decided(item, "accepted", "recheck/restart", speed, self._pace.max_speed)
            self._shift = self._matrix(self._shifted(last)) @ inverse_of(self._matrix(doubt))
            self._last, self._doubt = item, None
            yield self._shifted(doubt)
            yield self._shifted(item)

    def drop_doubt(self) -> Iterator[Decision]:
        if self._doubt is not None:
            yield decided(self._doubt, "refused", *self._breach)
            self._doubt = None

    def _shifted(self, item: OdometryPose) -> OdometryPose:
        if self._shift is None:
            return item
        before = self._matrix(item)
        after = self._shift @ before
        covariance = item.covariance.reshape(6, 6).copy()
        covariance[self._unused] = covariance[:, self._unused] = 0.0
        with np.errstate(all="ignore"):  # where `noise` does not read it, it has not been judged
            at_child = covariance_from_ros(covariance, before[:3, :3])
            turned = covariance_to_ros(at_child, after[:3, :3])
        return replace(item, pose=frozen(seven_of_matrix(after)), covariance=frozen(turned.reshape(36)))

    def _matrix(self, item: OdometryPose) -> Array:
        """(4, 4); what stands on axes that do not count, be it NaN, must not spread to those that do."""
        matrix = matrix_of(item.pose)
        if 2 in self._unused:
            matrix[2, 3] = 0.0
        return matrix
