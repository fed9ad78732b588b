"""Odometry in order: each message against the one before it, and against the one that follows."""

from collections.abc import Iterator
from dataclasses import replace
from math import dist, hypot, inf
from typing import NamedTuple

import numpy as np

from ..geometry import covariance_from_ros, covariance_to_ros, inverse_of, matrix_of, seven_of_matrix
from ..graph import Decision
from ..measurement import SECOND, Array, Measurement, frozen
from ..sensors.odometry import HERE, OdometryPose
from ..space import SPACES, Space, interpolate
from .rules import ACCELERATION, AWAY, JITTER, JUMP, decided


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
        meters = self._between(last, item)
        if meters > AWAY and tuple(item.pose.tolist()) == HERE:
            return Breach("recheck/origin", meters, AWAY)
        seconds = (item.stamp - last.stamp) / SECOND
        limit = min(self.max_speed, self._told(last, item) + ACCELERATION * seconds)
        if meters <= limit * seconds + JITTER:
            return None
        return Breach("recheck/teleport", meters / seconds, limit)

    def follows(self, last: Measurement, doubt: Measurement | None, item: Measurement) -> bool:
        """Whether a message goes on from the last that was believed, rather than from a doubtful one: what could be either is nearer."""
        if self.breach(last, item) is not None:
            return False
        if doubt is None or self.breach(doubt, item) is not None:
            return True
        return self._between(last, item) <= self._between(doubt, item)

    def _between(self, one: Measurement, other: Measurement) -> float:
        """Metres."""
        assert isinstance(one, OdometryPose)
        assert isinstance(other, OdometryPose)
        n = self._dimension
        return dist(one.pose.tolist()[:n], other.pose.tolist()[:n])

    def _told(self, last: OdometryPose, item: OdometryPose) -> float:
        """Twice the speed (m/s) that they state themselves; without a word about it any is possible."""
        told = [each for each in (last, item) if each.twist.any() or each.twist_covariance.any()]
        return max((2 * hypot(*each.twist.tolist()[: self._dimension]) for each in told), default=inf)


UNBOUND = Pace(inf, SPACES["3d"])


class Continuity:
    """Of one odometry source: the last message believed, and a doubtful one that waits for the next.

    A jump, or another frame, that the next message confirms is a restart: the odometry's frame moved, the robot did not, or nobody
    saw it. A new epoch begins, whose poses are shifted so that the robot went on as it did before: at constant velocity, for JUMP at most.
    """

    def __init__(self, pace: Pace, space: Space) -> None:
        self._pace, self._space = pace, space
        self._unused = [axis for axis in range(6) if axis not in space.used]
        self._before: OdometryPose | None = None  # of the same epoch as the last
        self._last: OdometryPose | None = None
        self._doubt: OdometryPose | None = None
        self._breach = Breach("")  # of the doubtful one
        self._shift: Array | None = None  # (4, 4), first frame from that of the epoch
        self._epoch = 0

    def judge(self, item: OdometryPose) -> Iterator[Measurement | Decision]:
        last, doubt = self._last, self._doubt
        if last is not None and item.stamp <= last.stamp:
            yield decided(item, "refused", "recheck/duplicate")
        elif last is None or self._pace.follows(last, doubt, item):
            if doubt is not None:
                yield from self.drop_doubt()
            self._before, self._last = last, item
            yield self._shifted(item)
        elif doubt is not None and item.stamp == doubt.stamp:  # no witness: it may be the same message again
            yield decided(item, "refused", "recheck/duplicate")
        elif doubt is None or self._pace.breach(doubt, item) is not None:
            yield from self.drop_doubt()
            self._doubt, self._breach = item, self._pace.breach(last, item) or self._breach
        else:
            speed = self._breach.statistic
            yield decided(item, "accepted", "recheck/restart", speed, self._pace.max_speed)
            there = self._matrix(self._shifted(last)) @ self._went_on(last, doubt.stamp)
            self._shift = there @ inverse_of(self._matrix(doubt))
            self._epoch += 1
            self._before, self._last, self._doubt = doubt, item, None
            yield self._shifted(doubt)
            yield self._shifted(item)

    def drop_doubt(self) -> Iterator[Decision]:
        if self._doubt is not None:
            yield decided(self._doubt, "refused", *self._breach)
            self._doubt = None

    def _went_on(self, last: OdometryPose, stamp: int) -> Array:
        """(4, 4) motion since the last message, at the velocity that it had."""
        if self._before is None:
            return np.eye(4)
        start, end = (self._space.pose(each.pose.tolist()) for each in (self._before, last))
        seconds = min(stamp - last.stamp, JUMP * SECOND)
        ahead = interpolate(self._space, start, end, 1 + seconds / (last.stamp - self._before.stamp))
        return matrix_of(np.array(self._space.seven(end.between(ahead))))

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
        return replace(
            item, pose=frozen(seven_of_matrix(after)), covariance=frozen(turned.reshape(36)),
            epoch=self._epoch, origin=tuple(seven_of_matrix(self._shift).tolist()),
        )  # fmt: skip

    def _matrix(self, item: OdometryPose) -> Array:
        """(4, 4); what stands on axes that do not count, be it NaN, must not spread to those that do."""
        matrix = matrix_of(item.pose)
        if 2 in self._unused:
            matrix[2, 3] = 0.0
        return matrix
