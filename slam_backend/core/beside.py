"""Odometries beside the one that drives: each adds edges of its own between the keyframes that are made without it.

An edge leads from a keyframe to the next one that the odometry saw. Where its messages are close together, its pose at a keyframe is
interpolated; where it was silent, the message nearest to a keyframe lands there, as any other measurement does, and the edge spans
what lies between. It enters with the first keyframe that comes after its ends are covered. Across a restart there is none.
"""

from collections.abc import Iterator, Sequence
from math import isfinite
from typing import NamedTuple

import numpy as np

from .config import OdometrySource
from .context import Context, unknown_frame
from .graph import Decision, Factor, Keyframe, Motion, Offer, Pose, identify
from .keyframes import Placed, Track
from .measurement import SECOND, Array, format_stamp
from .mounts import SPATIAL, Mounts
from .robust.kernels import noise_of
from .sensors.odometry import OdometryPose, stated
from .space import Space
from .waiting import refusal

HOLE = SECOND // 2  # ns between two messages, beyond which nothing is interpolated
LEVEL = 1e-6  # of the cosine of a sensor's tilt


class Anchor(NamedTuple):
    """Where the odometry is asked about a keyframe: at a stamp that lies at the keyframe, or lands there."""

    placed: Placed
    stamp: int


class Beside:
    """One such odometry."""

    def __init__(self, name: str, settings: OdometrySource, space: Space, mounts: Mounts) -> None:
        self._name, self._settings, self._space, self._mounts = name, settings, space, mounts
        self._early: OdometryPose | None = None  # the newest from before the first keyframe
        self._epochs: list[_Epoch] = []

    def add(self, item: OdometryPose, begun: bool) -> list[Decision]:
        """begun: there is a keyframe. Refused is what comes from a frame of which nobody says where it is."""
        if not begun:
            self._early = item
            return []
        early, self._early = self._early, None
        return [told for each in (early, item) if each is not None for told in self._take(each)]

    def _take(self, item: OdometryPose) -> Iterator[Decision]:
        last = self._epochs[-1] if self._epochs else None
        if last is None or last.number != item.epoch:
            mount = self._mounts.whole(item.child.lstrip("/"))
            if mount is None:
                why = unknown_frame(item.child)
                yield refusal(Offer(identify(item, 0), item), "odometry", why.reason, why.detail)
                return
            next_ = last.next if last else 0
            self._epochs.append(_Epoch(self._space, self._settings, mount, item, next_))
        self._epochs[-1].add(item)

    def edges(self, keyframes: Sequence[Keyframe], context: Context) -> list[Factor]:
        """Those that can be made by now. keyframes: all, in order of stamp."""
        self._epochs = [epoch for epoch in self._epochs if not epoch.spent]
        found = [edge for epoch in self._epochs for edge in epoch.edges(self._name, keyframes, context)]
        for epoch in self._epochs[:-1]:
            epoch.spent = True
        return found

    def rewind(self) -> None:
        """The edges of the last call did not enter: they will be made again."""
        for epoch in self._epochs:
            epoch.rewind()


class _Epoch:
    """From one restart to the next. Its track holds poses of the base, seen from the first: so they lie in the robot's plane,
    whatever the axes of the odometry's own frame.
    """

    def __init__(
        self, space: Space, settings: OdometrySource, mount: Pose, first: OdometryPose, next_: int
    ) -> None:
        """mount: `base_T_child` in 3-D. next_: number of the first keyframe that is of interest."""
        self.number, self.next, self.spent = first.epoch, next_, False
        self._space, self._settings = space, settings
        self._child_T_base = mount.inverse()
        self._adjoint = space.pose(SPATIAL.seven(mount)).AdjointMap()
        self._is_level = space.name == "3d" or mount.matrix()[2, 2] > 1 - LEVEL
        self._start = self._base(first).inverse()
        self._track = Track(space, settings)
        self._anchor: Anchor | None = None
        self._before: tuple[int, Anchor | None] = next_, None

    def add(self, item: OdometryPose) -> None:
        pose = self._space.pose(SPATIAL.seven(self._start.compose(self._base(item))))
        self._track.add(item.stamp, pose, self._stated(item))

    def _base(self, item: OdometryPose) -> Pose:
        """`odom_T_base` in 3-D; what a planar robot says of its height may be anything."""
        x, y, z, *rotation = item.pose.tolist()
        seven = (x, y, z if isfinite(z) else 0.0, *rotation)
        return SPATIAL.pose(seven).compose(self._child_T_base)

    def _stated(self, item: OdometryPose) -> Array | None:
        """As the track's noise mode needs it; zeros: unknown. A plane cannot tell what a tilted sensor states."""
        track = self._track
        seconds = (item.stamp - track.newest) / SECOND if len(track) else 0.0
        covariance = stated(self._space, self._settings, item, seconds)
        return covariance if covariance is None or self._is_level else np.zeros_like(covariance)

    def edges(self, name: str, keyframes: Sequence[Keyframe], context: Context) -> Iterator[Factor]:
        self._before = self.next, self._anchor
        while self.next < len(keyframes) and keyframes[self.next].stamp <= self._track.newest:
            anchor = self._anchored(keyframes[self.next], context)
            if anchor is None and self.next == len(keyframes) - 1:
                break  # what was said last may land there, or at the next one
            self.next += 1
            if anchor is not None and self._anchor is not None:
                yield self._edge(name, self._anchor, anchor)
            self._anchor = anchor or self._anchor
        if self._before[1] is not None:
            self._track.forget(self._before[1].stamp)
        self._track.protect()

    def rewind(self) -> None:
        (self.next, self._anchor), self.spent = self._before, False

    def _anchored(self, keyframe: Keyframe, context: Context) -> Anchor | None:
        """None where the odometry was silent, and nothing that it said lands at this keyframe."""
        if not self._track.covers(keyframe.stamp):
            return None
        before, after = self._track.beside(keyframe.stamp)
        if after - before <= HOLE:
            return Anchor(Placed(keyframe, None), keyframe.stamp)
        nearest = before if keyframe.stamp - before <= after - keyframe.stamp else after
        placed = context.place(nearest)
        return Anchor(placed, nearest) if placed is not None and placed.keyframe is keyframe else None

    def _edge(self, name: str, a: Anchor, b: Anchor) -> Factor:
        motion = self._track.motion(a.stamp, b.stamp)
        moved = Motion(motion.pose, self._adjoint @ motion.covariance @ self._adjoint.T)
        moved = a.placed.motion.then(moved) if a.placed.motion else moved
        moved = moved.then(b.placed.motion.inverse()) if b.placed.motion else moved
        keys, stamp = (a.placed.keyframe.pose, b.placed.keyframe.pose), b.placed.keyframe.stamp
        factor = self._space.between(*keys, moved.pose, noise_of(moved.covariance))
        return Factor(f"{name}/{format_stamp(stamp)}/0", "odometry", factor, keys, stamp)
