"""The back-end as it is read: snapshots, places on the earth, what another session needs. Nothing here changes anything."""

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np
from gtsam import symbolIndex

from .books import Books
from .condition import Condition, conditions
from .config import GnssSource
from .consistency import Fit
from .fixes import Compared
from .georeference import Georeference, georeference
from .graph import EARTH, Keyframe
from .measurement import Array
from .sensors.imu import bias_key, velocity_key
from .sessions import SavedMap, joined
from .trajectory import Snapshot, States, Trajectory
from .variables import is_posed, moved, value_in


class Reading:
    def __init__(self, books: Books) -> None:
        self._books = books

    def snapshot(self) -> Snapshot:
        """Everything believed now; costs time in proportion to the graph."""
        books, space = self._books, self._books.space
        keyframes, estimate = books.timeline.in_order(), books.applier.estimate
        stamps = np.array([k.stamp for k in keyframes], dtype=np.int64)
        values = estimate.values() if estimate else gtsam.Values()
        sevens = space.sevens(values, [k.pose for k in keyframes])
        rows = {each.stamp: row for row, each in enumerate(keyframes)}
        sessions = [(track, rows[first.stamp]) for track, first in books.tracks.starts(keyframes)]
        odometry = joined(
            [track.trajectory().from_start(sevens[row], keyframes[row].stamp) for track, row in sessions]
            or [books.track.trajectory()]
        )
        names, points, orientations = self._landmarks(values)
        return Snapshot(
            Trajectory(stamps, sevens, stamps[[row for _, row in sessions[1:]]]),
            np.array([k.index for k in keyframes], dtype=np.int64),
            odometry,
            names,
            points,
            books.revision,
            _states(values, keyframes) if books.imu else States(),
            orientations,
            self.georeference(),
        )

    def _landmarks(self, values: gtsam.Values) -> tuple[tuple[str, ...], Array, dict[str, Array]]:
        """Their names, (N, 3) where they are, and (7,) of those that have an orientation, by name."""
        books, space = self._books, self._books.space
        names = tuple(name for name, key in books.landmarks.items() if books.parts.of(key) is not None)
        points = np.zeros((len(names), 3))
        orientations: dict[str, Array] = {}
        for row, name in zip(points, names, strict=True):
            value = value_in(space, values, key := books.landmarks[name])
            if is_posed(key):
                seven = np.array(space.seven(value))
                row[:], orientations[name] = seven[:3], seven[3:]
            else:
                row[: space.point_dimension] = value
        return names, points, orientations

    def saved(self, online: Trajectory, run_hash: str = "") -> SavedMap:
        """What another session needs to go on from here. online: what was believed of each keyframe when it was newest."""
        books = self._books
        keyframes = tuple(books.timeline.keyframes)
        return SavedMap(
            books.space.name, tuple(books.solver.factors.values()), books.estimate.values(), keyframes,
            dict(books.landmarks), dict(books.parts.all()), dict(books.applier.sighted),
            tuple(track.samples() for track in books.tracks if len(track)), online, books.revision, run_hash,
            None if books.origin is None else tuple(books.origin),
        )  # fmt: skip

    def recent(self, count: int) -> Fit:
        """The newest factors at the present estimate; what is older than all of them is held where it is."""
        books = self._books
        factors = list(books.solver.factors.values())[-count:]
        values = gtsam.Values()
        for key in sorted({key for factor in factors for key in factor.keys}):
            values.insert(key, books.estimate.value(key))
        begin = min(
            (symbolIndex(f.keys[0]) for f in factors if f.kind == "motion"), default=len(books.timeline)
        )
        born = {key: pose for key, (pose, _) in books.applier.sighted.items()}
        return Fit(factors, values, lambda key: symbolIndex(born.get(key, key)) > begin and key != EARTH)

    def georeference(self) -> Georeference | None:
        """How the map lies on the earth; None without a source of fixes."""
        books = self._books
        if books.applier.estimate is None or not any(
            isinstance(source, GnssSource) for source in books.config.sources.values()
        ):
            return None
        part = books.parts.of(EARTH)
        first = next((k.pose for k in books.timeline.keyframes if books.parts.of(k.pose) == part), None)
        why = books.waiting.why(EARTH) or ("no fix has been used" if books.origin else "no fix has come")
        kept = books.solver.factors.__contains__
        return georeference(books.space, books.estimate, books.origin, first, kept, why)

    def conditions(self) -> Mapping[str, Condition]:
        """How each source does, by name."""
        return conditions(self._books, self.georeference())

    def earth(self) -> Array | None:
        """(7,) `map_T_earth`: where the frame east, north, up at `origin` lies in the map; None before that is known."""
        books = self._books
        if books.applier.estimate is None or not books.estimate.knows(EARTH):
            return None
        return np.array(books.space.seven(books.estimate.pose(EARTH)))

    def compared(self, snapshot: Snapshot) -> Compared | None:
        """Every fix beside where its antenna is believed to have been; None without any."""
        books = self._books
        if books.origin is None or not len(books.fixes):
            return None
        return books.fixes.compared(snapshot, self.earth(), books.origin, books.mounts.whole)

    def dead_reckoning(self) -> gtsam.Values:
        """Where everything would be by odometry alone, landmarks where their first sighting puts them."""
        books, values = self._books, gtsam.Values()
        keyframes = books.timeline.in_order()
        for track, first in books.tracks.starts(keyframes):
            start = books.estimate.pose(first.pose).compose(track.pose(first.stamp).inverse())
            for each in keyframes:
                if track.covers(each.stamp):
                    values.insert(each.pose, start.compose(track.pose(each.stamp)))
        for key, (pose_key, seen) in books.applier.sighted.items():
            values.insert(key, moved(books.space.pose_in(values, pose_key), key, seen))
        return values


def _states(values: gtsam.Values, keyframes: Sequence[Keyframe]) -> States:
    """keyframes: in order of stamp."""
    found = [k for k in keyframes if values.exists(velocity_key(k)) and values.exists(bias_key(k))]
    numbers = [
        (*values.atVector(velocity_key(k)), *values.atConstantBias(bias_key(k)).vector()) for k in found
    ]
    stamps = np.array([k.stamp for k in found], dtype=np.int64)
    return States(stamps, np.array(numbers, dtype=np.float64).reshape(-1, 9))
