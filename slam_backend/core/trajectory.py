"""Poses at any stamp, and the state of the back-end as plain arrays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .geometry import inverse_of, matrix_of, seven_of_matrix
from .measurement import Array

Stamps = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """`map_T_base` over time. stamps: (N,) ns, strictly increasing. sevens: (N, 7) x y z qx qy qz qw."""

    stamps: Stamps
    sevens: Array

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def poses(self) -> Array:
        """(N, 4, 4)"""
        return matrix_of(self.sevens)

    def at(self, stamps: ArrayLike) -> Array:
        """(M, 7) interpolated at (M,) ns: positions linearly, rotations along great circles (slerp, Shoemake 1985).

        Rows of NaN outside the trajectory.
        """
        wanted = np.asarray(stamps, dtype=np.int64)
        if not len(self):
            return np.full((len(wanted), 7), np.nan)
        right = np.clip(np.searchsorted(self.stamps, wanted), 1, max(len(self.stamps) - 1, 1))
        left = right - 1
        if len(self.stamps) == 1:
            right = left
        span = np.maximum(self.stamps[right] - self.stamps[left], 1)
        ratio = ((wanted - self.stamps[left]) / span)[:, None]
        before, after = self.sevens[left], self.sevens[right]
        result = np.empty((len(wanted), 7))
        result[:, :3] = before[:, :3] + ratio * (after[:, :3] - before[:, :3])
        result[:, 3:] = slerp(before[:, 3:], after[:, 3:], ratio)
        result[(wanted < self.stamps[0]) | (wanted > self.stamps[-1])] = np.nan
        return result

    def from_start(self, start: Array, stamp: int | None = None) -> "Trajectory":
        """The same motion, moved as a whole so that its pose at `stamp` (none: its first) is `start` (7,)."""
        begin = self.sevens[0] if stamp is None else self.at([stamp])[0]
        moved = matrix_of(start) @ inverse_of(matrix_of(begin)) @ self.poses
        return Trajectory(self.stamps, seven_of_matrix(moved))


def slerp(before: Array, after: Array, ratio: Array) -> Array:
    """(N, 4) unit quaternions at (N, 1) ratios of the shorter arc; nearly equal ones are blended linearly."""
    dot = np.sum(before * after, axis=1, keepdims=True)
    after = np.where(dot < 0, -after, after)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.sin(angle)
    near = sine < 1e-6
    safe = np.where(near, 1.0, sine)
    first = np.where(near, 1 - ratio, np.sin((1 - ratio) * angle) / safe)
    second = np.where(near, ratio, np.sin(ratio * angle) / safe)
    blended = first * before + second * after
    return np.asarray(blended / np.linalg.norm(blended, axis=1, keepdims=True))


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """The estimate at one moment, a copy that never changes.

    trajectory: every keyframe in order of stamp. indices: (N,) their indices. odometry: what odometry alone says, from
    the same start, at every sample that is kept. landmarks: (L, 3) in map, with `names`; revision: see Backend.
    """

    trajectory: Trajectory
    indices: Stamps
    odometry: Trajectory
    names: tuple[str, ...]
    landmarks: Array
    revision: int

    @property
    def stamps(self) -> Stamps:
        return self.trajectory.stamps

    @property
    def poses(self) -> Array:
        """(N, 4, 4) map_T_base"""
        return self.trajectory.poses
