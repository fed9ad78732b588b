"""Several drives in one map. Each has an odometry of its own; between the end of one and the start of the next nothing is known."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from .errors import SlamError
from .graph import Factor, Keyframe
from .keyframes import Samples, Track
from .trajectory import Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class SavedMap:
    """All that a back-end must know of a map to go on in it.

    values: of every variable. keyframes: in order of index. landmarks: name -> key. parts: variable -> number of its
    component. sighted: variable other than a keyframe's pose -> the first pose that it was tied to, and the value from there. tracks: the odometry of each session, in
    order of time. online: what was believed of each keyframe when it was newest. origin: of the earth, latitude, longitude,
    altitude; None for a map without fixes.
    """

    space: str
    factors: tuple[Factor, ...]
    values: gtsam.Values
    keyframes: tuple[Keyframe, ...]
    landmarks: Mapping[str, int]
    parts: Mapping[int, int]
    sighted: Mapping[int, tuple[int, Any]]
    tracks: tuple[Samples, ...]
    online: Trajectory
    revision: int
    run_hash: str = field(default="")
    origin: tuple[float, ...] | None = None

    @property
    def end(self) -> int:
        """Its newest stamp; a session that goes on must be later."""
        samples = max((int(track.stamps[-1]) for track in self.tracks if len(track.stamps)), default=0)
        return max(samples, *(k.stamp for k in self.keyframes))


def fits(saved: SavedMap, space: str) -> None:
    """SlamError where a map is of another space."""
    if saved.space != space:
        raise SlamError(f"the map was made in space {saved.space}, and this is space {space}")


class Tracks:
    """The odometry of every session, the present one last."""

    def __init__(self, present: Track) -> None:
        self._all = [present]

    def __iter__(self) -> Iterator[Track]:
        return iter(self._all)

    def before(self, earlier: list[Track]) -> None:
        """Sessions that came before the present one, in order of time."""
        self._all = [*earlier, *self._all]

    def of(self, stamp: int) -> Track | None:
        """The one that covers a stamp."""
        return next((track for track in reversed(self._all) if track.covers(stamp)), None)

    def starts(self, keyframes: list[Keyframe]) -> list[tuple[Track, Keyframe]]:
        """Each session that has keyframes, with the first of them. keyframes: in order of stamp."""
        found = []
        for track in self._all:
            first = next((each for each in keyframes if track.covers(each.stamp)), None)
            if first is not None:
                found.append((track, first))
        return found


def joined(trajectories: list[Trajectory]) -> Trajectory:
    """One after the other; nothing is known between two."""
    filled = [each for each in trajectories if len(each)] or trajectories[:1]
    return Trajectory(
        np.concatenate([each.stamps for each in filled]),
        np.concatenate([each.sevens for each in filled]),
        np.array([each.stamps[0] for each in filled[1:]], dtype=np.int64),
    )
