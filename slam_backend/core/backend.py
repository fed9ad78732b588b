"""The back-end: measurements in, small updates out, snapshots when asked. No clock, no file, no thread, no ROS.

What drives the keyframes is in `drive.py`, how sensors are asked in `sensing.py`, how a change enters the graph in `change.py`, what is
read in `reading.py`, what they share in `books.py`.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gtsam

from .adopted import Adopted
from .books import Books
from .change import Change, Update
from .command import Command
from .condition import Condition
from .config import Config, GnssSource, LandmarkSource, OdometrySource, PoseSource, RelativeSource
from .consistency import Fit
from .drive import Drive
from .edits import Wishes
from .errors import SlamError
from .firewall.rules import decided
from .fixes import Compared
from .georeference import Georeference
from .graph import Delta, Estimate, Factor, Offer
from .growth import Growth
from .keyframes import Track
from .measurement import Array, Constant, Measurement, StaticTransform
from .reading import Reading
from .robust import Robust
from .sensing import Sensing
from .sensors.camera import CameraModel
from .sensors.gnss import Fix, grounded
from .sensors.relative import RelativePose
from .sessions import SavedMap, fits
from .settle import FAR
from .solvers import SOLVERS, Solver
from .space import SPACES
from .splitting import twins_of
from .trajectory import Snapshot, Trajectory

__all__ = ["SOURCES", "Backend", "Update"]

SOURCES = {  # of a configuration that names none: one of each kind, by the name of its kind
    "odometry": OdometrySource(),
    "relative": RelativeSource(),
    "landmark": LandmarkSource(),
    "pose": PoseSource(),
}


class Backend:
    """The core of live node and replay alike. Measurements must come in settled order (see `settle`).

    A config without sources takes measurements whose source is named as its kind: odometry, relative, landmark, pose.
    """

    def __init__(
        self,
        config: Config | None = None,
        solver: Solver | None = None,
        robust: Sequence[Robust] | None = None,
    ) -> None:
        """solver, robust: instead of those that the config names."""
        config = config or Config()
        self.config = config = config if config.sources else config.model_copy(update={"sources": SOURCES})
        self.space = space = SPACES[config.space]
        self.solver = solver = solver or SOLVERS["isam2"](config, space)
        self._books = books = Books(config, solver)
        self.timeline, self.track, self.parts = books.timeline, books.track, books.parts
        self.calibration, self.landmark = books.calibration, books.landmark
        self._applier, self._waiting = books.applier, books.waiting
        self._growth = Growth(space, books.timeline, books.track, books.parts)
        self._sensing = Sensing(books)
        self._drive = Drive(books, self._sensing, self._growth)
        self._change = Change(books, self._drive, self._sensing, robust)
        self._reading, self.jury, self._paths = Reading(books), self._change.jury, self._change.paths
        self._by_edges = config.sources[books.driver].kind == "relative"
        self._is_complete = False  # nothing was offered since the last keyframes along edges were made

    def load(self, saved: SavedMap) -> None:
        """Go on in a saved map: what comes is a part of its own, until a measurement joins it to the map. SlamError if it cannot be."""
        books = self._books
        if len(books.timeline):
            raise SlamError("a map can be loaded only before the first keyframe: reset first")
        fits(saved, self.space.name)
        books.applier.load(saved)
        for each in saved.keyframes:
            books.timeline.add(each)
        books.landmarks |= saved.landmarks
        books.twins |= twins_of(saved.landmarks, saved.factors)
        self._sensing.restore(saved.landmarks)
        noise = books.track.noise
        books.tracks.before([Track(self.space, noise).restore(each) for each in saved.tracks])
        books.waiting.remember(factor.id for factor in saved.factors if factor.kind != "gauge")
        self._growth.begins = saved.end
        books.revision = saved.revision
        books.origin = saved.origin or books.origin

    def add(self, measurement: Measurement) -> list[Update]:
        """Take the next measurement; return an update for each keyframe that it made."""
        books = self._books
        if isinstance(measurement, Constant):
            if isinstance(measurement, StaticTransform):
                books.mounts.add(measurement)
            elif isinstance(measurement, CameraModel):
                self._sensing.see(measurement)
            return []
        if isinstance(measurement, Command):
            return self._change.carry_out(measurement)
        if (stamps := self._drive.takes(measurement)) is not None:
            return self._extend(stamps) if stamps else []
        if self._by_edges and isinstance(measurement, RelativePose) and measurement.source == books.driver:
            books.mounts.name_base(measurement.frame_j)
        if isinstance(measurement, Fix):
            measurement = grounded(measurement, self.space)
            if not self._takes(measurement):
                books.decisions.append(decided(measurement, "refused", "gnss/withheld"))
                return []
        updates = self.complete(measurement.stamp)
        books.decisions += books.waiting.offer(measurement)
        self._is_complete = False
        if (coaster := self._drive.coaster) and measurement.source == books.driver:
            updates += self._extend(self._drive.coast(measurement, coaster))
        return updates

    def complete(self, stamp: int) -> list[Update]:
        """All that is older than `stamp` has been told: edges that drive the keyframes need wait no longer for their equals.

        `add` does so by itself.
        """
        waiting = self._books.waiting
        if not self._by_edges or self._is_complete or not waiting or stamp <= waiting.newest:
            return []
        self._is_complete = True
        return self._close()

    def finish(self) -> list[Update]:
        """The input has ended: land what still waits; decide about what cannot land."""
        books, updates = self._books, list[Update]()
        if not self._by_edges and books.newest and books.track.newest > books.newest[0].stamp:
            updates += self._extend([books.track.newest])
        updates += self._close(last=True)
        if books.newest and books.calibration:
            self._change.calibrate(books.newest[0].stamp)
        while books.newest and books.waiting:  # what was waiting for that, or was put back
            updates += self._close(last=True)
        books.decisions += books.waiting.leftovers()
        if books.newest and (edges := self._drive.edges_beside()):
            updates += self._change.apply(books.newest[0], Delta(edges), [], [])
        if books.newest and self.jury:
            self._change.end()
        if books.newest and books.decisions:
            updates.append(self._change.told(books.newest[0]))
        return updates

    def polish(self) -> None:
        """Linearize everything anew at the present estimate; what iSAM2 believes rests on older points."""
        if self._books.newest:
            self._applier.estimate = self.solver.polish()

    def adopt(self, values: gtsam.Values) -> None:
        """Believe what a batch solve of the same factors found, until the next measurement."""
        self._applier.estimate = Adopted(values, self.space, self.estimate)

    # -- what is read (see `reading.py`) -----------------------------------------------------------

    @property
    def estimate(self) -> Estimate:
        """What the solver believes now. SlamError before the first keyframe."""
        return self._books.estimate

    @property
    def origin(self) -> Sequence[float] | None:
        """Of east, north, up: latitude, longitude, altitude; None before the first fix."""
        return self._books.origin

    @property
    def left_out(self) -> list[Factor]:
        """Factors that were offered and are not in the graph: refused, on probation, or taken out by a person."""
        return self._change.editor.left_out

    def dry_run(self, action: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """What a command would come to; nothing is touched. SlamError where it would be refused."""
        return self._change.dry_run(action, arguments)

    @property
    def wishes(self) -> Wishes:
        """What a person has decided about single factors."""
        return self._change.editor.wishes

    def snapshot(self) -> Snapshot:
        """Everything believed now; costs time in proportion to the graph."""
        return self._reading.snapshot()

    def saved(self, online: Trajectory, run_hash: str = "") -> SavedMap:
        """What another session needs to go on from here. online: what was believed of each keyframe when it was newest."""
        return self._reading.saved(online, run_hash)

    def recent(self, count: int) -> Fit:
        """The newest factors at the present estimate; what is older than all of them is held where it is."""
        return self._reading.recent(count)

    def conditions(self) -> Mapping[str, Condition]:
        """How each source does, by name: see core/condition.py."""
        return self._reading.conditions()

    def earth(self) -> Array | None:
        """(7,) `map_T_earth`: where the frame east, north, up at `origin` lies in the map; None before that is known."""
        return self._reading.earth()

    def georeference(self) -> Georeference | None:
        """How the map lies on the earth; None without a source of fixes."""
        return self._reading.georeference()

    def compared(self, snapshot: Snapshot) -> Compared | None:
        """Every fix beside where its antenna is believed to have been; None without any."""
        return self._reading.compared(snapshot)

    def dead_reckoning(self) -> gtsam.Values:
        """Where everything would be by odometry alone, landmarks where their first sighting puts them."""
        return self._reading.dead_reckoning()

    # -- the way of a measurement ----------------------------------------------------------------

    def _takes(self, fix: Fix) -> bool:
        """Book a fix; whether it is to be used."""
        books, source = self._books, self.config.sources.get(fix.source)
        books.origin = books.origin or tuple(fix.place.tolist())
        return not isinstance(source, GnssSource) or books.fixes.add(fix, source)

    def _extend(self, stamps: Iterable[int]) -> list[Update]:
        """New keyframes at stamps that the odometry covers; each is there before the next stamp is asked for."""
        return [update for stamp in stamps for update in self._keyframe(stamp)]

    def _keyframe(self, stamp: int) -> list[Update]:
        """One keyframe, with everything that lands there."""
        books, drive = self._books, self._drive
        a = books.newest[0] if books.newest else None
        by_imu, stretch = books.imu == books.driver, drive.stretched(stamp)
        if by_imu and stretch is None:
            return []
        b, begun = drive.start(stamp) if a is None else (self._growth.follow(a, stamp), None)
        motion = self._sensing.motion(stamp, a, b)
        delta = motion if begun is None else begun + motion
        if by_imu and stretch is not None:
            drive.follow(stretch)
        books.newest = (b, books.track.pose(stamp))
        books.track.protect()
        window = books.waiting.window(stamp)
        others = [Offer("", Measurement(stamp, books.imu))] if stretch is not None and not by_imu else []
        if edges := drive.edges_beside():
            delta += Delta(edges)
        if others or window:
            delta += self._sensing.factors(others + window, a, b, delta.values)
        updates = self._change.apply(b, delta, [b], window)
        drive.begun(b, stretch)
        return updates

    def _close(self, last: bool = False) -> list[Update]:
        """Without odometry: the measurements of one stamp are complete; their edges make the keyframes.

        last: the input has ended; what is newer than the newest keyframe lands now or never.
        """
        books = self._books
        before = len(books.timeline)
        growth, edges = self._growth.along(books.waiting.of(books.driver), self._sensing.context)
        new = books.timeline.keyframes[before:]
        a = books.newest[0] if books.newest else None
        b = max(new, key=lambda k: k.stamp, default=a)
        if b is not None and (a is None or b.stamp > a.stamp):
            books.newest = (b, books.track.pose(b.stamp))
        window = edges + (
            books.waiting.window(FAR if last else books.newest[0].stamp) if books.newest else []
        )
        if b is None or not window:
            books.decisions += growth.decisions
            return []
        return self._change.apply(b, growth + self._sensing.factors(window, a, b, growth.values), new, window)
