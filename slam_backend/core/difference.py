"""What changed between two beliefs: what moved, how far, and the factors that came or went between them."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .backend import Update
from .geometry import inverse_of, matrix_of
from .graph import Factor
from .measurement import Array
from .trajectory import Snapshot, Stamps

EVERYDAY = frozenset(
    {"motion", "odometry", "landmark", "gnss", "floor", "gauge"}
)  # kinds of factors that are only counted
STILL = 1e-6  # m or rad: less is rounding


class Shift(NamedTuple):
    meters: float
    radians: float


class Jumps:
    """How far each update moved the newest pose from where the one before would have it."""

    def __init__(self) -> None:
        self.of: dict[str, Shift] = {}  # factor id -> the jump of the update that took it
        self._last: Update | None = None

    def add(self, update: Update) -> None:
        last, self._last = self._last, update
        if last is None:
            return
        here = matrix_of(np.array(update.pose))
        in_odom = inverse_of(matrix_of(np.array(update.correction))) @ here
        jump = _shift(matrix_of(np.array(last.correction)) @ in_odom, here)
        self.of |= {decision.id: jump for decision in update.decisions}


@dataclass(frozen=True, slots=True, eq=False)
class Event:
    """A factor that is no everyday one: a loop or an absolute pose. jump: of the newest pose, with all that entered in that update."""

    id: str
    kind: str
    stamps: tuple[int, int] | None
    jump: Shift | None


@dataclass(frozen=True, slots=True, eq=False)
class Difference:
    """stamps, indices: (N,) of the keyframes that both beliefs have. meters, radians: (N,) how far each moved in the map.

    names, landmarks: (L,) of the landmarks that both have, and how far each moved (m). came: kind -> factors that are in the
    later belief only.
    """

    stamps: Stamps
    indices: Stamps
    meters: Array
    radians: Array
    names: tuple[str, ...]
    landmarks: Array
    keyframes: tuple[int, int]
    revisions: tuple[int, int]
    came: Mapping[str, int]
    events: tuple[Event, ...]
    went: tuple[str, ...]

    @property
    def moved(self) -> int:
        """How many keyframes are somewhere else."""
        return int(np.count_nonzero((self.meters > STILL) | (self.radians > STILL)))


def difference(
    before: Snapshot,
    after: Snapshot,
    then: Mapping[str, Factor],
    now: Mapping[str, Factor],
    jumps: Jumps,
) -> Difference:
    """then, now: the kept factors by id."""
    _, first, second = np.intersect1d(before.stamps, after.stamps, return_indices=True)
    meters, radians = _shifts(before.poses[first], after.poses[second])
    places = dict(zip(after.names, after.landmarks, strict=True))
    common = {
        name: point for name, point in zip(before.names, before.landmarks, strict=True) if name in places
    }
    distances = [float(np.linalg.norm(places[name] - point)) for name, point in common.items()]
    fresh = [factor for id_, factor in now.items() if id_ not in then]
    return Difference(
        before.stamps[first], before.indices[first], meters, radians,
        tuple(common), np.array(distances),
        (len(before.stamps), len(after.stamps)), (before.revision, after.revision),
        dict(Counter(factor.kind for factor in fresh)),
        tuple(
            Event(f.id, f.kind, f.stamps, jumps.of.get(f.id)) for f in fresh if f.kind not in EVERYDAY
        ),
        tuple(id_ for id_ in then if id_ not in now),
    )  # fmt: skip


def _shift(a: Array, b: Array) -> Shift:
    meters, radians = _shifts(a[None], b[None])
    return Shift(float(meters[0]), float(radians[0]))


def _shifts(a: Array, b: Array) -> tuple[Array, Array]:
    """(N,) distances in m and angles in rad between two (N, 4, 4) in one frame."""
    between = np.swapaxes(a[:, :3, :3], 1, 2) @ b[:, :3, :3]
    skew = between - np.swapaxes(between, 1, 2)
    sine = np.linalg.norm(np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]]), axis=0) / 2
    angles = np.arctan2(sine, (np.trace(between, axis1=1, axis2=2) - 1) / 2)
    return np.linalg.norm(b[:, :3, 3] - a[:, :3, 3], axis=1), angles
