"""Odometry in order: each message against the one before it, and against the one that follows."""

from collections.abc import Iterator
from dataclasses import replace
from math import dist

import numpy as np

from ..geometry import covariance_from_ros, covariance_to_ros, inverse_of, matrix_of, seven_of_matrix
from ..graph import Decision
from ..measurement import SECOND, Array, Measurement, frozen
from ..sensors.odometry import OdometryPose
from ..space import Space
from .rules import JITTER, decided


class Continuity:
    """Of one odometry source: the last message believed, and a doubtful one that waits for the next.

    A jump, or another frame, that the next message confirms is a restart: the odometry's frame moved, the robot did not. From
    then on its poses are shifted so that the track goes on where it was.
    """

    def __init__(self, max_speed: float, space: Space) -> None:
        """max_speed: m/s."""
        self._max_speed, self._space = max_speed, space
        self._unused = [axis for axis in range(6) if axis not in space.used]
        self._last: OdometryPose | None = None
        self._doubt: OdometryPose | None = None
        self._shift: Array | None = None  # (4, 4), old frame from new frame

    def judge(self, item: OdometryPose) -> Iterator[Measurement | Decision]:
        last, doubt = self._last, self._doubt
        if last is not None and item.stamp <= last.stamp:
            yield decided(item, "refused", "recheck/duplicate")
        elif last is None or self._follows(last, item):
            yield from self.drop_doubt()
            self._last = item
            yield self._shifted(item)
        elif doubt is not None and item.stamp == doubt.stamp:  # no witness: it may be the same message again
            yield decided(item, "refused", "recheck/duplicate")
        elif doubt is None or not self._follows(doubt, item):
            yield from self.drop_doubt()
            self._doubt = item
        else:
            speed = self._speeding(last, doubt)
            yield decided(item, "accepted", "recheck/restart", speed, self._max_speed)
            self._shift = self._matrix(self._shifted(last)) @ inverse_of(self._matrix(doubt))
            self._last, self._doubt = item, None
            yield self._shifted(doubt)
            yield self._shifted(item)

    def drop_doubt(self) -> Iterator[Decision]:
        if self._doubt is not None and self._last is not None:
            if _share_frames(self._last, self._doubt):
                speed = self._speeding(self._last, self._doubt)
                yield decided(self._doubt, "refused", "recheck/teleport", speed, self._max_speed)
            else:
                yield decided(self._doubt, "refused", "recheck/frame_changed")
            self._doubt = None

    def _follows(self, last: OdometryPose, item: OdometryPose) -> bool:
        return _share_frames(last, item) and self._speeding(last, item) is None

    def _speeding(self, last: OdometryPose, item: OdometryPose) -> float | None:
        """The speed in m/s between two messages where it exceeds the bound."""
        n = self._space.point_dimension
        meters = dist(last.pose[:n].tolist(), item.pose[:n].tolist())
        seconds = max((item.stamp - last.stamp) / SECOND, 1e-9)
        return meters / seconds if meters > self._max_speed * seconds + JITTER else None

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


def _share_frames(a: OdometryPose, b: OdometryPose) -> bool:
    return a.frame == b.frame and a.child == b.child
