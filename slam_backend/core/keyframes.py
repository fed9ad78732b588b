"""Motion between any two stamps, and when a keyframe is due.

How a measurement between keyframes lands: the interpolated odometry between its own stamp and the nearest
keyframe is composed into the measurement, and the odometry's noise over that stretch into its covariance. So a
measurement of any age lands at its own stamp and costs no variable. The stretch is at most half a keyframe
step, and its correlation with the edge between the keyframes (the same odometry is used twice) is neglected: it is
second order beside the measurement's own noise. Where it is not (centimetre landmarks on a coarse
keyframe grid), a source with `keyframe: true` has a keyframe made at the stamp of each of its measurements.
"""

from array import array
from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass

import numpy as np

from .config import Keyframes, OdometrySource
from .graph import Keyframe, Motion, Pose
from .measurement import SECOND, Array
from .space import Space, interpolate
from .trajectory import Stamps, Trajectory

LOOSE = 1.0  # m and rad after 1 m or 1 rad: grounds are less uneven
LOST = 3.2  # rad: nothing is known of a rotation
MADE = 8  # poses of samples that are kept as objects
SAMPLES_PER_STEP = 32  # odometry samples kept between two keyframes; a parked robot must not fill the memory


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Of a track. stamps: (N,) ns. numbers: (N, k) poses as `Space.numbers`. covariances: (N, d, d), or none.

    strands: (N,) which samples share a frame: -1 with the first ones, else the strand's number.
    """

    stamps: Stamps
    numbers: Array
    covariances: Array
    strands: Stamps


class Track:
    """The odometry as a function of time: samples, interpolated along constant twists.

    Noise over a stretch, by `OdometrySource.noise`:
        model  variances that grow with the distance and the angle between its ends, and a floor
        twist  each message's twist covariance held over the time since the last, as independent errors; the model's
               growth on axes whose variance is zero
        pose   the pose covariance at the end minus that at the start, seen from the end; the model where
               the difference is not positive definite (covariances that shrink or stand still)
    Across a restart nothing was measured: there the robot is thought to go on at constant velocity, disturbed by white noise on its
    acceleration (Barfoot, State Estimation for Robotics, 2017, ch. 11).
    """

    def __init__(self, space: Space, noise: OdometrySource) -> None:
        self._space, self.noise = space, noise
        self._floor = space.diagonal(noise.sigma_rotation_floor**2, noise.sigma_translation_floor**2)
        self._stamps = array("q")
        self._columns: tuple[
            array[float], ...
        ] = ()  # of Space.numbers, one row per sample: a tuple takes five times the room
        self._covariances: list[Array] = []  # per sample; only for noise `twist` (of the step) and `pose`
        self._protected = 0  # index of the newest sample that may not be thinned away
        self._leaps: list[tuple[int, int, Array]] = []  # (before, after, covariance) of each restart
        self._strands: dict[
            int, int
        ] = {}  # stamp -> strand, of samples that share no frame with the first ones
        self._made: dict[
            int, Pose
        ] = {}  # of the samples added or asked for last, by index: a keyframe asks five times

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp: int, pose: Pose, covariance: Array | None = None) -> None:
        """Append a sample, or insert it in stamp order. covariance: as `noise` needs it, at the child's tangent."""
        at = len(self._stamps)
        if at and stamp < self._stamps[-1]:
            at = bisect_left(self._stamps, stamp)
        if at and covariance is not None and self.noise.noise == "twist":
            covariance = self._filled(covariance, self._sample(at - 1).between(pose))
        self._protected += at <= self._protected < len(self._stamps)
        if at < len(self._stamps):
            self._made.clear()
        self._stamps.insert(at, stamp)
        numbers = self._space.numbers(pose)
        self._columns = self._columns or tuple(array("d") for _ in numbers)
        for column, number in zip(self._columns, numbers, strict=True):
            column.insert(at, number)
        if self._space.exact:
            self._keep(at, pose)
        if covariance is not None:
            self._covariances.insert(at, covariance)
        if len(self._stamps) - self._protected > 2 * SAMPLES_PER_STEP:
            self._thin()

    def leap(self, stamp: int, pose: Pose, covariance: Array | None = None) -> None:
        """Append the first sample after a restart."""
        before = self._stamps[-1]
        self.add(stamp, pose, covariance)
        seconds = (stamp - before) / SECOND
        turned, moved = self.noise.sigma_angular_acceleration**2, self.noise.sigma_acceleration**2
        turned = min(turned * seconds**3 / 3, LOST**2)
        self._leaps.append((before, stamp, self._space.diagonal(turned, moved * seconds**3 / 3)))

    def beside(self, stamp: int) -> tuple[int, int]:
        """The stamps of the samples before and after one that is covered; twice the same where it is a sample's own."""
        right = bisect_left(self._stamps, stamp)
        after = self._stamps[right]
        return (after, after) if after == stamp else (self._stamps[right - 1], after)

    def forget(self, stamp: int) -> None:
        """What is older than a stamp that is covered will not be asked for any more."""
        gone = max(bisect_right(self._stamps, stamp) - 1, 0)
        self._drop(slice(0, gone))
        self._protected = max(self._protected - gone, 0)

    def protect(self) -> None:
        """A keyframe stands at the newest sample: what follows is a new step."""
        self._protected = max(len(self._stamps) - 1, 0)

    def split(self, stamp: int, beside: int) -> None:
        """The sample at `stamp` lies in the frame of the one at `beside`; where these are the same, in a frame of its own.

        Edges that make keyframes make as many tracks as there are parts; between two of them nothing can be interpolated.
        """
        strand = stamp if stamp == beside else self._strands.get(beside)
        if strand is not None:
            self._strands[stamp] = strand

    def samples(self) -> Samples:
        stamps = np.array(self._stamps, dtype=np.int64)
        strands = np.array([self._strands.get(stamp, -1) for stamp in stamps.tolist()], dtype=np.int64)
        return Samples(stamps, self._rows(), np.array(self._covariances), strands)

    def restore(self, samples: Samples) -> "Track":
        """Take over the samples of a track that is finished."""
        self._stamps = array("q", samples.stamps.tolist())
        self._columns = tuple(array("d", column) for column in samples.numbers.T.tolist())
        self._covariances = list(samples.covariances)
        self._made.clear()
        strands = zip(samples.stamps.tolist(), samples.strands.tolist(), strict=True)
        self._strands = {stamp: strand for stamp, strand in strands if strand >= 0}
        self.protect()
        return self

    def covers(self, stamp: int) -> bool:
        if not self._stamps or not self._stamps[0] <= stamp <= self._stamps[-1]:
            return False
        if not self._strands:
            return True
        right = bisect_left(self._stamps, stamp)
        after = self._stamps[right]
        return after == stamp or self._strands.get(after) == self._strands.get(self._stamps[right - 1])

    @property
    def newest(self) -> int:
        return self._stamps[-1]

    def trajectory(self) -> Trajectory:
        """`odom_T_base` at every sample that is kept."""
        if not self._stamps:
            return Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 7)))
        stamps, rows = np.unique(np.array(self._stamps, dtype=np.int64), return_index=True)
        return Trajectory(stamps, self._space.sevens_of(self._rows()[rows]))

    def pose(self, stamp: int) -> Pose:
        """`odom_T_base` at a stamp that the track covers."""
        right = bisect_left(self._stamps, stamp)
        if self._stamps[right] == stamp:
            return self._sample(right)
        before, after = self._stamps[right - 1], self._stamps[right]
        ratio = (stamp - before) / (after - before)
        return interpolate(self._space, self._sample(right - 1), self._sample(right), ratio)

    def motion(self, start: int, end: int) -> Motion:
        """`start_T_end` and its covariance at the tangent of end; both stamps must be covered."""
        if start == end:
            return Motion(self._space.identity, np.zeros((self._space.dimension,) * 2))
        if start > end:
            return self.motion(end, start).inverse()
        first, last = self.pose(start), self.pose(end)
        pose = first.between(last)
        return Motion(pose, self._covariance(start, end, pose, last))

    def _sample(self, index: int) -> Pose:
        made = self._made.get(index)
        if made is None:
            made = self._space.pose_of_numbers([column[index] for column in self._columns])
            self._keep(index, made)
        return made

    def _keep(self, index: int, pose: Pose) -> None:
        if len(self._made) >= MADE:
            self._made.clear()
        self._made[index] = pose

    def _rows(self) -> Array:
        return np.ascontiguousarray(np.array(self._columns).T)

    def _covariance(self, start: int, end: int, motion: Pose, last: Pose) -> Array:
        grown: Array | None = None
        if self.noise.noise == "twist" and self._covariances:
            grown = self._of_twists(start, end, last)
        if self.noise.noise == "pose" and self._covariances:
            grown = self._of_poses(start, end, motion)
        if grown is None:
            grown = growth(self._space, self.noise, motion)
        elif self.noise.planar:
            grown = self._space.flat(grown, *loose(self._space, motion))
        found = self._floor + grown
        return found + self._of_leaps(start, end, last) if self._leaps else found

    def _of_leaps(self, start: int, end: int, last: Pose) -> Array:
        total = np.zeros((self._space.dimension,) * 2)
        for before, after, covariance in self._leaps:
            if start < after and before < end:
                share = (min(after, end) - max(before, start)) / (after - before)
                adjoint = last.between(self.pose(min(after, end))).AdjointMap()
                total += share * (adjoint @ covariance @ adjoint.T)
        return total

    def _filled(self, step: Array, motion: Pose) -> Array:
        """The covariance of a step with the model's growth where a variance is zero."""
        unknown = np.diag(step) <= 0
        return (
            step + np.diag(unknown * np.diag(growth(self._space, self.noise, motion)))
            if unknown.any()
            else step
        )

    def _of_twists(self, start: int, end: int, last: Pose) -> Array:
        total = np.zeros((self._space.dimension,) * 2)
        for i in range(max(bisect_right(self._stamps, start), 1), bisect_left(self._stamps, end) + 1):
            before, after = self._stamps[i - 1], self._stamps[i]
            share = (min(after, end) - max(before, start)) / (after - before)
            if after == end:
                total += share * self._covariances[i]
            else:
                adjoint = last.between(self._sample(i)).AdjointMap()
                total += share * (adjoint @ self._covariances[i] @ adjoint.T)
        return total

    def _of_poses(self, start: int, end: int, motion: Pose) -> Array | None:
        adjoint = motion.inverse().AdjointMap()
        grown = self._stated(end) - adjoint @ self._stated(start) @ adjoint.T
        grown = (grown + grown.T) / 2
        return grown if np.linalg.eigvalsh(grown)[0] > 0 else None

    def _stated(self, stamp: int) -> Array:
        right = bisect_left(self._stamps, stamp)
        if self._stamps[right] == stamp:
            return self._covariances[right]
        before, after = self._stamps[right - 1], self._stamps[right]
        ratio = (stamp - before) / (after - before)
        return (1 - ratio) * self._covariances[right - 1] + ratio * self._covariances[right]

    def _thin(self) -> None:
        """Drop every second sample of the current step; step covariances are handed to the next sample."""
        drop = range(self._protected + 1, len(self._stamps) - 1, 2)
        if self._covariances and self.noise.noise == "twist":
            for i in drop:
                adjoint = self._sample(i + 1).between(self._sample(i)).AdjointMap()
                self._covariances[i + 1] = (
                    self._covariances[i + 1] + adjoint @ self._covariances[i] @ adjoint.T
                )
        self._drop(slice(drop.start, drop.stop, 2))

    def _drop(self, where: slice) -> None:
        self._made.clear()
        del self._stamps[where]
        for column in self._columns:
            del column[where]
        if self._covariances:
            del self._covariances[where]


def growth(space: Space, noise: OdometrySource, motion: Pose) -> Array:
    """Covariance of a stretch by the model: with the distance and the angle between its ends, without the floor."""
    meters, radians = space.size(motion)
    grown = space.diagonal(
        noise.sigma_rotation_per_meter**2 * meters + noise.sigma_rotation_per_radian**2 * radians,
        noise.sigma_translation_per_meter**2 * meters + noise.sigma_translation_per_radian**2 * radians,
    )
    return space.flat(grown, *loose(space, motion)) if noise.planar else grown


def loose(space: Space, motion: Pose) -> tuple[float, float]:
    """Variances of rotation and translation over a stretch, on axes that a planar odometry does not see."""
    size = sum(space.size(motion))
    return LOOSE**2 * size, LOOSE**2 * size


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Where a stamp lies: `keyframe_T_stamp`; motion is None when the stamp is the keyframe's own."""

    keyframe: Keyframe
    motion: Motion | None


class Timeline:
    """The keyframes by index and by stamp."""

    def __init__(self) -> None:
        self.keyframes: list[Keyframe] = []
        self._stamps: list[int] = []
        self._by_stamp: dict[int, Keyframe] = {}

    def __len__(self) -> int:
        return len(self.keyframes)

    def add(self, keyframe: Keyframe) -> None:
        self.keyframes.append(keyframe)
        self._by_stamp[keyframe.stamp] = keyframe
        if not self._stamps or keyframe.stamp > self._stamps[-1]:
            self._stamps.append(keyframe.stamp)
        else:
            insort(self._stamps, keyframe.stamp)

    def drop(self, keyframe: Keyframe) -> None:
        """Take back the keyframe that was added last."""
        assert self.keyframes[-1] is keyframe
        self.keyframes.pop()
        del self._by_stamp[keyframe.stamp]
        self._stamps.remove(keyframe.stamp)

    @property
    def newest(self) -> Keyframe | None:
        return self._by_stamp[self._stamps[-1]] if self._stamps else None

    def at(self, stamp: int) -> Keyframe | None:
        return self._by_stamp.get(stamp)

    def in_order(self) -> list[Keyframe]:
        return [self._by_stamp[stamp] for stamp in self._stamps]

    def place(self, stamp: int, track: Track, space: Space) -> Placed | None:
        """The nearest keyframe (by distance moved, then by time) with the motion to the stamp.

        None when the stamp does not lie between two keyframes that the track covers.
        """
        if exact := self._by_stamp.get(stamp):
            return Placed(exact, None)
        right = bisect_left(self._stamps, stamp)
        beside = self._stamps[max(right - 1, 0) : right + 1]
        if len(beside) < 2 or not all(map(track.covers, (stamp, *beside))):
            return None
        here = track.pose(stamp)

        def distance(near: int) -> tuple[float, float, int]:
            meters, radians = space.size(track.pose(near).between(here))
            return meters, radians, abs(stamp - near)

        nearest = min(beside, key=distance)
        return Placed(self._by_stamp[nearest], track.motion(nearest, stamp))


def due(config: Keyframes, space: Space, motion: Pose, elapsed: int) -> bool:
    """Whether the motion or the time (ns) since the last keyframe asks for a new one."""
    if config.every:
        return True
    if config.time is not None and elapsed >= config.time * SECOND:
        return True
    meters, radians = space.size(motion)
    return meters >= config.distance or radians >= config.angle
