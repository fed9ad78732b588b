"""Poses at any stamp, and the state of the back-end as plain arrays."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .geometry import inverse_of, matrix_of, seven_of_matrix
from .georeference import Georeference
from .measurement import Array

Stamps = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """`map_T_base` over time. stamps: (N,) ns, strictly increasing. sevens: (N, 7) x y z qx qy qz qw.

    breaks: stamps at which another session begins: nothing is known between the pose before and that one.
    """

    stamps: Stamps
    sevens: Array
    breaks: Stamps = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def poses(self) -> Array:
        """(N, 4, 4)"""
        return matrix_of(self.sevens)

    def at(self, stamps: ArrayLike) -> Array:
        """(M, 7) interpolated at (M,) ns: positions linearly, rotations along great circles (slerp, Shoemake 1985).

        Rows of NaN outside the trajectory, and between sessions.
        """
        wanted = np.asarray(stamps, dtype=np.int64)
        result = np.full((len(wanted), 7), np.nan)
        if len(self):
            right = np.searchsorted(self.stamps, wanted)
            covered = (self.stamps[0] <= wanted) & (right < len(self)) & ~self.between_sessions(wanted)
            result[covered] = _sampled(self, wanted[covered], right[covered]).T
        return result

    def between_sessions(self, stamps: Stamps) -> NDArray[np.bool_]:
        """(M,) whether a stamp lies after the end of one session and before the start of the next."""
        rows = np.searchsorted(self.stamps, self.breaks)
        ends, n = self.stamps[rows - 1], np.searchsorted(self.breaks, stamps, side="right")
        found = np.zeros(len(stamps), dtype=np.bool_)
        inside = np.flatnonzero(n < len(self.breaks))
        found[inside] = stamps[inside] > ends[n[inside]]
        return found

    def from_start(self, start: Array, stamp: int | None = None) -> "Trajectory":
        """The same motion, moved as a whole so that its pose at `stamp` (none: its first) is `start` (7,)."""
        begin = self.sevens[0] if stamp is None else self.at([stamp])[0]
        moved = matrix_of(start) @ inverse_of(matrix_of(begin)) @ self.poses
        return Trajectory(self.stamps, seven_of_matrix(moved))


def shaped(keyframes: Trajectory, odometry: Trajectory, stamps: ArrayLike) -> Array:
    """(M, 7) `map_T_base` at (M,) ns: between two keyframes a and b the shape of the odometry O, bent to meet both.

        X(t) = X_a (O_a^-1 O(t)) Exp(s Log((O_a^-1 O_b)^-1 X_a^-1 X_b)),   s the share of the time from a to b

    The keyframes themselves are met to the bit. Where the odometry does not cover the stretch, or has no sample inside
    it and so no shape, plain interpolation (`Trajectory.at`). Rows of NaN outside the keyframes, and between sessions.
    """
    wanted = np.asarray(stamps, dtype=np.int64)
    rows, right, begins, ends = _with_shape(keyframes.stamps, odometry.stamps, wanted)
    if len(keyframes.breaks):
        known = ~keyframes.between_sessions(wanted[rows])
        rows, right, begins, ends = (each[known] for each in (rows, right, begins, ends))
    plain = np.ones(len(wanted), dtype=np.bool_)
    plain[rows] = False
    result = np.empty((len(wanted), 7))
    result[plain] = keyframes.at(wanted[plain])
    if len(rows):
        wanted, start, end = wanted[rows], keyframes.stamps[right - 1], keyframes.stamps[right]
        at_start, at_end = _sampled(odometry, start, begins), _sampled(odometry, end, ends)
        here = _sampled(odometry, wanted, np.searchsorted(odometry.stamps, wanted))
        first, second = _columns(keyframes.sevens, right - 1), _columns(keyframes.sevens, right)
        missing = _between(_between(at_start, at_end), _between(first, second))
        bent = _part(missing, (wanted - start) / (end - start))
        result[rows] = _composed(first, _composed(_between(at_start, here), bent)).T
    return result


def _with_shape(keyframes: Stamps, odometry: Stamps, wanted: Stamps) -> Stamps:
    """(4, K): which stamps lie on a stretch that the odometry covers and has a sample inside of; the keyframe at the
    stretch's end; where searchsorted has the stretch's start and end in the odometry.
    """
    right = np.searchsorted(keyframes, wanted)
    rows = np.flatnonzero((right > 0) & (right < len(keyframes)))
    right = right[rows]
    start, end = keyframes[right - 1], keyframes[right]
    begins, ends = np.searchsorted(odometry, start), np.searchsorted(odometry, end)
    good = np.flatnonzero((wanted[rows] < end) & (begins < ends) & (ends < len(odometry)))
    good = good[start[good] >= odometry[:1]]  # [:1]: there may be none
    own = odometry[begins[good]] == start[good]  # the sample found is the start's, not one inside
    good = good[begins[good] + own < ends[good]]
    return np.stack([rows[good], right[good], begins[good], ends[good]])


# Poses as columns, (7, N) x y z qx qy qz qw: a row of each number is several times faster than 4x4 matrices.


def _sampled(track: Trajectory, wanted: Stamps, right: Stamps) -> Array:
    """(7, N) at stamps that the track covers and searchsorted has at `right`: positions on straight lines, rotations on
    the shorter arcs.
    """
    result, after = _columns(track.sevens, right), track.stamps[right]
    if len(rows := np.flatnonzero(after != wanted)):
        right, wanted, after = right[rows], wanted[rows], after[rows]
        before = track.stamps[right - 1]
        ratio = (wanted - before) / (after - before)
        result[:, rows] = _blended(_columns(track.sevens, right - 1), result[:, rows], ratio)
    return result


def _columns(sevens: Array, rows: Stamps) -> Array:
    return np.ascontiguousarray(np.take(sevens, rows, axis=0).T)


def _blended(first: Array, second: Array, ratio: Array) -> Array:
    """Rotations that are nearly equal are blended linearly: their arc has no sine to divide by."""
    position = first[:3] + ratio * (second[:3] - first[:3])
    dot = _dot(first[3:], second[3:]) + first[6] * second[6]
    angle = np.arccos(np.minimum(np.abs(dot), 1.0))
    sine = np.sin(angle)
    near = sine < 1e-6
    safe = np.where(near, 1.0, sine)
    weight = np.where(near, 1 - ratio, np.sin((1 - ratio) * angle) / safe)
    other = np.where(near, ratio, np.sin(ratio * angle) / safe) * np.where(dot < 0, -1.0, 1.0)
    blended = weight * first[3:] + other * second[3:]
    blended /= np.sqrt(_dot(blended, blended) + blended[3] ** 2)
    return np.concatenate([position, blended])


def _composed(first: Array, second: Array) -> Array:
    """a_T_b and b_T_c to a_T_c."""
    return np.concatenate([first[:3] + _turned(first[3:], second[:3]), _times(first[3:], second[3:])])


def _between(first: Array, second: Array) -> Array:
    """c_T_a and c_T_b to a_T_b."""
    back = np.stack([-first[3], -first[4], -first[5], first[6]])
    return np.concatenate([_turned(back, second[:3] - first[:3]), _times(back, second[3:])])


def _part(poses: Array, share: Array) -> Array:
    """Exp(share Log(pose)): (7, N) along the screws that lead to the poses, shares (N,) of the way."""
    position, quaternion = poses[:3], np.where(poses[6] < 0, -poses[3:], poses[3:])
    sine = np.sqrt(_dot(quaternion, quaternion))
    still = sine == 0
    sine[still] = 1.0
    half = np.arctan2(sine, quaternion[3])  # of the angle; meaningless where nothing turns
    axis = quaternion[:3] / sine
    s, c = np.sin(half * share), np.cos(half * share)
    # V^-1 of Log, then s V(s) of Exp, for the parts of the translation along and across the axis
    along = axis * _dot(axis, position)
    across = half * (quaternion[3] / sine * (position - along) - _cross(axis, position))
    moved = share * along + (s / half) * (c * across + s * _cross(axis, across))
    moved[:, still] = share[still] * position[:, still]
    c[still] = 1.0
    return np.concatenate([moved, axis * s, c[None]])


def _turned(q: Array, v: Array) -> Array:
    """(3, N) vectors rotated by (4, N) unit quaternions."""
    twice = 2 * _cross(q[:3], v)
    return np.asarray(v + q[3] * twice + _cross(q[:3], twice))


def _times(p: Array, q: Array) -> Array:
    vector = p[3] * q[:3] + q[3] * p[:3] + _cross(p[:3], q[:3])
    return np.concatenate([vector, (p[3] * q[3] - _dot(p[:3], q[:3]))[None]])


def _cross(a: Array, b: Array) -> Array:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """Of the keyframes that an IMU reaches. stamps: (M,) ns, increasing. numbers: (M, 9) velocity in the map (m/s), bias of the
    accelerometer (m/s^2) and of the gyroscope (rad/s) in the IMU's frame.
    """

    stamps: Stamps = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    numbers: Array = field(default_factory=lambda: np.zeros((0, 9)))

    def at(self, stamp: int, keyframes: Stamps) -> Array | None:
        """(9,) at a stamp between `keyframes` (N,), linearly from one to the next; None where one of the two has none."""
        right = int(np.searchsorted(keyframes, stamp))
        beside = (
            keyframes[right : right + 1] if keyframes[right] == stamp else keyframes[right - 1 : right + 1]
        )
        rows = np.searchsorted(self.stamps, beside)
        if (rows >= len(self.stamps)).any() or (self.stamps[rows] != beside).any():
            return None
        share = (stamp - beside[0]) / (beside[-1] - beside[0]) if len(beside) > 1 else 0.0
        return np.asarray((1 - share) * self.numbers[rows[0]] + share * self.numbers[rows[-1]])


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """The estimate at one moment, a copy that never changes.

    trajectory: every keyframe in order of stamp. indices: (N,) their indices. odometry: what odometry alone says, from
    the same start, at every sample that is kept. landmarks: (L, 3) in map, with `names`; revision: see Backend. states: by an IMU.
    orientations: of the landmarks that have one, (4,) qx qy qz qw in map, by name. earth: how the map lies there; None without fixes.
    """

    trajectory: Trajectory
    indices: Stamps
    odometry: Trajectory
    names: tuple[str, ...]
    landmarks: Array
    revision: int
    states: States = field(default_factory=States)
    orientations: Mapping[str, Array] = field(default_factory=dict)
    earth: Georeference | None = None

    @property
    def stamps(self) -> Stamps:
        return self.trajectory.stamps

    @property
    def poses(self) -> Array:
        """(N, 4, 4) map_T_base"""
        return self.trajectory.poses

    def at(self, stamps: ArrayLike) -> Array:
        """(M, 7) `map_T_base` at (M,) ns, between keyframes in the shape of the odometry: see `shaped`."""
        return shaped(self.trajectory, self.odometry, stamps)
