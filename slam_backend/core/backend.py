"""The back-end: measurements in, small updates out, snapshots when asked. No clock, no file, no thread, no ROS."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from gtsam import symbolIndex

from .adopted import Adopted
from .apply import Applier, without
from .association import Associator
from .beside import Beside
from .budget import Budget
from .calibration import Calibration
from .coast import NAME, NOISE, Coaster, coasts, earth_from, floor_from, sight_of
from .command import Command
from .config import Config, GnssSource, LandmarkSource, OdometrySource, PoseSource, RelativeSource
from .consistency import Fit
from .context import Context, Unusable, unknown_frame
from .editor import Editor, Shift
from .edits import Wishes
from .errors import BadConfig, SlamError, SolverFailure
from .firewall.rules import decided
from .fixes import Compared, Fixes
from .floor import priors
from .georeference import Georeference, georeference
from .graph import (
    DATUM,
    EARTH,
    Decision,
    Delta,
    Estimate,
    Factor,
    Keyframe,
    Offer,
    Pose,
    identify,
    landmark_key,
    tag_key,
    total,
)
from .growth import TILT, Growth
from .inertial import ImuSample, Inertial, State, Stretch, imu_of, pace_from
from .jury import Jury
from .keyframes import Timeline, Track, due
from .measurement import SECOND, Array, Constant, Measurement, StaticTransform
from .mounts import Mounts
from .parts import Parts
from .quarantine import Quarantine
from .reunion import Reunion, reunion
from .robust import ROBUST, Doubt, Robust
from .robust.paths import Paths
from .sensors import SENSORS
from .sensors.camera import CameraModel
from .sensors.gnss import Fix
from .sensors.imu import bias_key, velocity_key
from .sensors.odometry import HERE, OdometryPose, stated
from .sensors.pose import AbsolutePose
from .sensors.relative import RelativePose
from .sessions import SavedMap, Tracks, fits, joined
from .settle import FAR
from .solvers import SOLVERS, Solver
from .space import SPACES
from .trajectory import Snapshot, States, Trajectory
from .variables import is_posed, moved, value_in
from .waiting import Waiting, refusal

STEP = SECOND // 20  # ns between samples of the track where the IMU drives

SOURCES = {  # of a configuration that names none: one of each kind, by the name of its kind
    "odometry": OdometrySource(),
    "relative": RelativeSource(),
    "landmark": LandmarkSource(),
    "pose": PoseSource(),
}


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """What one keyframe changed; plain data, small enough to send each time.

    pose: `map_T_base` of the keyframe; correction: `map_T_odom`; both x y z qx qy qz qw. origin: where the driving odometry's frame
    has been since its last restart, in that odom.
    revision: grows whenever a solver update corrects the newest pose noticeably.
    state: where an IMU reaches it, velocity (m/s, in the map) and bias, accelerometer first; 9 numbers.
    """

    keyframe: Keyframe
    pose: tuple[float, ...]
    correction: tuple[float, ...]
    revision: int
    decisions: tuple[Decision, ...]
    origin: tuple[float, ...] = HERE
    state: tuple[float, ...] = ()


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
        self.solver = solver or SOLVERS["isam2"](config, space)
        self._paths = paths = Paths(space, config.gate.odometry_scale, self.solver.factors)
        self._quarantine = Quarantine(config, space, self.solver.factors)
        self._budget = Budget(config, space, self.solver.factors, lambda: self._editor.wishes.ids)
        self._driver = config.driver
        if self._driver is None:
            raise BadConfig(
                "no source drives the keyframes: add one of kind odometry, imu, relative, gnss or pose"
            )
        driving = config.sources[self._driver]
        self._relative = driving.kind == "relative"
        self._imu = next((name for name, s in config.sources.items() if s.kind == "imu"), "")
        self._inertial = Inertial(self._imu, imu) if (imu := imu_of(config)) else None
        self._pace = pace_from(config)
        self._stretch: Stretch | None = None  # of the keyframe that is being made
        self._coaster = Coaster(space, config.coast) if coasts(config) else None
        self._earth, self._floor = earth_from(config), floor_from(config)
        told = driving if isinstance(driving, OdometrySource) else OdometrySource()
        self.track = Track(space, NOISE if self._coaster else told)
        self.tracks = Tracks(self.track)
        self.timeline = Timeline()
        self.parts = Parts()
        self.origin: Sequence[float] | None = (
            config.earth.origin
        )  # of east, north, up: latitude, longitude, altitude
        self.fixes = Fixes()
        self._mounts = Mounts(space, config.base_frame, config.extrinsics)
        self._beside = {
            name: Beside(name, source, space, self._mounts)
            for name, source in config.sources.items()
            if isinstance(source, OdometrySource) and name != self._driver
        }
        self._epoch, self._origin = 0, HERE  # of the driving odometry
        self._cameras: dict[str, CameraModel] = {}
        self._memory: dict[str, Any] = {}  # of sensors, by source
        self._landmarks: dict[str, int] = {}
        self._associators = {
            name: Associator(name, source, space)
            for name, source in config.sources.items()
            if isinstance(source, LandmarkSource)
        }
        self._waiting = Waiting(config)
        self.calibration = Calibration(config, space)
        self._waiting.late = self.calibration.late
        self._is_complete = False  # nothing was offered since the last keyframes along edges were made
        self._growth = Growth(space, self.timeline, self.track, self.parts)
        self._decisions: list[Decision] = []  # told with the next update
        self._newest: tuple[Keyframe, Pose] | None = None  # and its odometry pose
        stages = _stages(config, paths, self._quarantine, self._budget) if robust is None else robust
        self._is_judged = bool(stages)
        self._applier = Applier(self.solver, space, self.parts, self._waiting.wake, self._book)
        self._editor = Editor(
            self.solver, space, self._applier, lambda key: self.timeline.keyframes[symbolIndex(key)].stamp
        )
        self.jury = Jury(stages, self._applier, self._editor)
        self._revision = 0

    def load(self, saved: SavedMap) -> None:
        """Go on in a saved map: what comes is a part of its own, until a measurement joins it to the map. SlamError if it cannot be."""
        if len(self.timeline):
            raise SlamError("a map can be loaded only before the first keyframe: reset first")
        fits(saved, self.space.name)
        self._applier.load(saved)
        for each in saved.keyframes:
            self.timeline.add(each)
        self._landmarks |= saved.landmarks
        for associator in self._associators.values():
            associator.restore(saved.landmarks)
        noise = self.track.noise
        self.tracks.before([Track(self.space, noise).restore(each) for each in saved.tracks])
        self._waiting.remember(factor.id for factor in saved.factors if factor.kind != "gauge")
        self._growth.begins = saved.end
        self._revision = saved.revision
        self.origin = saved.origin or self.origin

    def saved(self, online: Trajectory, run_hash: str = "") -> SavedMap:
        """What another session needs to go on from here. online: what was believed of each keyframe when it was newest."""
        keyframes = tuple(self.timeline.keyframes)
        return SavedMap(
            self.space.name, tuple(self.solver.factors.values()), self.estimate.values(), keyframes,
            dict(self._landmarks), dict(self.parts.all()), dict(self._applier.sighted),
            tuple(track.samples() for track in self.tracks if len(track)), online, self._revision, run_hash,
            None if self.origin is None else tuple(self.origin),
        )  # fmt: skip

    def add(self, measurement: Measurement) -> list[Update]:
        """Take the next measurement; return an update for each keyframe that it made."""
        if isinstance(measurement, Constant):
            if isinstance(measurement, StaticTransform):
                self._mounts.add(measurement)
            elif isinstance(measurement, CameraModel):
                self._cameras[measurement.source] = measurement
            return []
        if isinstance(measurement, Command):
            return self._carry_out(measurement)
        if (updates := self._flows(measurement)) is not None:
            return updates
        if self._relative and isinstance(measurement, RelativePose) and measurement.source == self._driver:
            self._mounts.name_base(measurement.frame_j)
        if isinstance(measurement, Fix) and not self._takes(measurement):
            self._decisions.append(decided(measurement, "refused", "gnss/withheld"))
            return []
        updates = self.complete(measurement.stamp)
        self._decisions += self._waiting.offer(measurement)
        self._is_complete = False
        if self._coaster and measurement.source == self._driver:
            updates += self._coast(measurement, self._coaster)
        return updates

    def complete(self, stamp: int) -> list[Update]:
        """All that is older than `stamp` has been told: edges that drive the keyframes need wait no longer for their equals.

        `add` does so by itself.
        """
        if not self._relative or self._is_complete or not self._waiting or stamp <= self._waiting.newest:
            return []
        self._is_complete = True
        return self._close()

    def finish(self) -> list[Update]:
        """The input has ended: land what still waits; decide about what cannot land."""
        updates: list[Update] = []
        if not self._relative and self._newest and self.track.newest > self._newest[0].stamp:
            updates += self._extend(self.track.newest)
        updates += self._close(last=True)
        if self._newest and self.calibration:
            self._calibrate(self._newest[0].stamp)
        while self._newest and self._waiting:  # what was waiting for that, or was put back
            updates += self._close(last=True)
        self._decisions += self._waiting.leftovers()
        if self._newest and (edges := self._edges_beside()):
            updates += self._update(self._newest[0], Delta(edges), [], [])
        if self._newest and self.jury:
            self._paths.ended = True
            self._hear(Delta())
        if self._newest and self._decisions:
            updates.append(self._told(self._newest[0]))
        return updates

    def polish(self) -> None:
        """Linearize everything anew at the present estimate; what iSAM2 believes rests on older points."""
        if self._newest:
            self._applier.estimate = self.solver.polish()

    def adopt(self, values: gtsam.Values) -> None:
        """Believe what a batch solve of the same factors found, until the next measurement."""
        self._applier.estimate = Adopted(values, self.space, self.estimate)

    @property
    def estimate(self) -> Estimate:
        """What the solver believes now. SlamError before the first keyframe."""
        if self._applier.estimate is None:
            raise SlamError("there is no keyframe yet: no message of the driving source has been accepted")
        return self._applier.estimate

    @property
    def left_out(self) -> list[Factor]:
        """Factors that were offered and are not in the graph: refused, on probation, or taken out by a person."""
        return self._editor.left_out

    def recent(self, count: int) -> Fit:
        """The newest factors at the present estimate; what is older than all of them is held where it is."""
        factors = list(self.solver.factors.values())[-count:]
        values = gtsam.Values()
        for key in sorted({key for factor in factors for key in factor.keys}):
            values.insert(key, self.estimate.value(key))
        begin = min(
            (symbolIndex(f.keys[0]) for f in factors if f.kind == "motion"), default=len(self.timeline)
        )
        born = {key: pose for key, (pose, _) in self._applier.sighted.items()}
        return Fit(factors, values, lambda key: symbolIndex(born.get(key, key)) > begin and key != EARTH)

    def snapshot(self) -> Snapshot:
        """Everything believed now; costs time in proportion to the graph."""
        keyframes = self.timeline.in_order()
        stamps = np.array([k.stamp for k in keyframes], dtype=np.int64)
        names = tuple(name for name, key in self._landmarks.items() if self.parts.of(key) is not None)
        values = self._applier.estimate.values() if self._applier.estimate else gtsam.Values()
        sevens = self.space.sevens(values, [k.pose for k in keyframes])
        points = np.zeros((len(names), 3))
        orientations: dict[str, Array] = {}
        for row, name in zip(points, names, strict=True):
            value = value_in(self.space, values, key := self._landmarks[name])
            if is_posed(key):
                seven = np.array(self.space.seven(value))
                row[:], orientations[name] = seven[:3], seven[3:]
            else:
                row[: self.space.point_dimension] = value
        rows = {each.stamp: row for row, each in enumerate(keyframes)}
        sessions = [(track, rows[first.stamp]) for track, first in self.tracks.starts(keyframes)]
        odometry = joined(
            [track.trajectory().from_start(sevens[row], keyframes[row].stamp) for track, row in sessions]
            or [self.track.trajectory()]
        )
        return Snapshot(
            Trajectory(stamps, sevens, stamps[[row for _, row in sessions[1:]]]),
            np.array([k.index for k in keyframes], dtype=np.int64),
            odometry,
            names,
            points,
            self._revision,
            self._states(values, keyframes) if self._imu else States(),
            orientations,
            self.georeference(),
        )

    def _states(self, values: gtsam.Values, keyframes: Sequence[Keyframe]) -> States:
        """keyframes: in order of stamp."""
        found = [k for k in keyframes if values.exists(velocity_key(k)) and values.exists(bias_key(k))]
        numbers = [
            (*values.atVector(velocity_key(k)), *values.atConstantBias(bias_key(k)).vector()) for k in found
        ]
        stamps = np.array([k.stamp for k in found], dtype=np.int64)
        return States(stamps, np.array(numbers, dtype=np.float64).reshape(-1, 9))

    def georeference(self) -> Georeference | None:
        """How the map lies on the earth; None without a source of fixes."""
        if self._applier.estimate is None or not any(
            isinstance(source, GnssSource) for source in self.config.sources.values()
        ):
            return None
        part = self.parts.of(EARTH)
        first = next((k.pose for k in self.timeline.keyframes if self.parts.of(k.pose) == part), None)
        why = self._waiting.why(EARTH) or ("no fix has been used" if self.origin else "no fix has come")
        return georeference(
            self.space, self.estimate, self.origin, first, self.solver.factors.__contains__, why
        )

    def earth(self) -> Array | None:
        """(7,) `map_T_earth`: where the frame east, north, up at `origin` lies in the map; None before that is known."""
        if self._applier.estimate is None or not self.estimate.knows(EARTH):
            return None
        return np.array(self.space.seven(self.estimate.pose(EARTH)))

    def compared(self, snapshot: Snapshot) -> Compared | None:
        """Every fix beside where its antenna is believed to have been; None without any."""
        if self.origin is None or not len(self.fixes):
            return None
        return self.fixes.compared(snapshot, self.earth(), self.origin, self._mounts.whole)

    def dead_reckoning(self) -> gtsam.Values:
        """Where everything would be by odometry alone, landmarks where their first sighting puts them."""
        values = gtsam.Values()
        keyframes = self.timeline.in_order()
        for track, first in self.tracks.starts(keyframes):
            start = self.estimate.pose(first.pose).compose(track.pose(first.stamp).inverse())
            for each in keyframes:
                if track.covers(each.stamp):
                    values.insert(each.pose, start.compose(track.pose(each.stamp)))
        for key, (pose_key, seen) in self._applier.sighted.items():
            values.insert(key, moved(self.space.pose_in(values, pose_key), key, seen))
        return values

    # -- the way of a measurement ----------------------------------------------------------------

    def _flows(self, measurement: Measurement) -> list[Update] | None:
        """Odometry and the IMU flow: added up until the next keyframe, not kept one by one. None: it is something else."""
        if isinstance(measurement, OdometryPose) and measurement.source == self._driver:
            return self._drive(measurement)
        if isinstance(measurement, OdometryPose) and measurement.source in self._beside:
            self._decisions += self._beside[measurement.source].add(measurement, bool(self._newest))
            return []
        if isinstance(measurement, ImuSample) and self._inertial and measurement.source == self._imu:
            return self._sample(measurement, self._inertial)
        return None

    def _drive(self, odometry: OdometryPose) -> list[Update]:
        """The driving odometry moves on: keyframes that were asked for, then one of its own if it is due."""
        self._mounts.name_base(odometry.child)
        pose = self.space.pose(odometry.pose.tolist())
        restarted = odometry.epoch != self._epoch and len(self.track) > 0
        self._epoch, self._origin = odometry.epoch, odometry.origin
        seconds = (odometry.stamp - self.track.newest) / SECOND if len(self.track) else 0.0
        noise = stated(self.space, self.track.noise, odometry, seconds)
        (self.track.leap if restarted else self.track.add)(odometry.stamp, pose, noise)
        return self._reached(odometry.stamp, restarted)

    def _reached(self, stamp: int, restarted: bool = False) -> list[Update]:
        """The track has come to this stamp: keyframes that were asked for, then one there if it is due."""
        updates: list[Update] = []
        for wanted in self._waiting.asked(stamp):
            if self.track.covers(wanted) and (self._newest is None or wanted > self._newest[0].stamp):
                updates += self._extend(wanted)
        if self._newest is None:
            return updates + self._extend(stamp)
        newest, there = self._newest
        moved, elapsed = there.between(self.track.pose(stamp)), stamp - newest.stamp
        if elapsed > 0 and (restarted or due(self._pace, self.space, moved, elapsed)):
            at = self._waiting.image(newest.stamp, stamp)
            updates += self._extend(at) if at is not None and self.track.covers(at) else []
            if at is None or (at < stamp and (restarted or self.config.keyframes.every)):
                updates += self._extend(stamp)
        return updates

    def _sample(self, sample: ImuSample, inertial: Inertial) -> list[Update]:
        """The IMU says something: kept for the next keyframe; where it drives, the track follows."""
        drives = self._imu == self._driver
        if drives:
            self._mounts.name_base(sample.frame)
        mount = self._mounts.get(sample.frame)
        if mount is None:
            why = unknown_frame(sample.frame)
            self._decisions.append(refusal(Offer(identify(sample, 0), sample), "imu", why.reason, why.detail))
            return []
        inertial.add(sample, None if mount is self.space.identity else mount)
        return self._propagate(sample, inertial) if drives else []

    def _propagate(self, sample: ImuSample, inertial: Inertial) -> list[Update]:
        updates: list[Update] = []
        if self._newest is None:
            if (first := inertial.ready) is None:
                return []
            updates += self._extend(first)
        for wanted in self._waiting.asked(sample.stamp):
            if self._newest and wanted > self._newest[0].stamp:
                updates += self._extend(wanted)
        if self._newest and sample.stamp - self.track.newest >= STEP:
            self.track.add(sample.stamp, self._newest[1].compose(inertial.moved(sample.stamp)))
            updates += self._reached(sample.stamp)
        return updates

    def _coast(self, item: Measurement, coaster: Coaster) -> list[Update]:
        """Nothing measures the motion: the track goes on as the positions before this one let expect."""
        assert isinstance(item, Fix | AbsolutePose)
        self._mounts.name_base(item.frame)
        settings = self.config.sources[item.source]
        assert isinstance(settings, GnssSource | PoseSource)
        try:
            steps = coaster.add(sight_of(item, self._context({}), settings))
        except Unusable:  # its sensor will say so
            return []
        self._decisions += coaster.take_decisions()
        updates: list[Update] = []
        for step in steps:
            if step.leaps and self._newest and self.track.newest > self._newest[0].stamp:
                updates += self._extend(self.track.newest)
            self.track.add(step.stamp, step.pose, step.covariance)
            updates += self._reached(step.stamp, step.leaps)
        return updates

    def _extend(self, stamp: int) -> list[Update]:
        """A new keyframe at a stamp that the odometry covers, with everything that lands there."""
        a = self._newest[0] if self._newest else None
        driver, settings = str(self._driver), self.config.sources[str(self._driver)]
        stretch = self._stretched(stamp)
        if settings.kind == "imu" and stretch is None:
            return []
        if a is None:
            b, delta = self._start(stamp)
        else:
            b, delta = self._growth.follow(a, stamp), Delta()
        mover, kind = (NAME, "odometry") if self._coaster else (driver, settings.kind)
        motion = [Offer("", Measurement(stamp, mover), motion=True)]
        delta += SENSORS[kind].factors(
            motion, a, b, self.calibration.context(self._context({}), driver), settings
        )
        if settings.kind == "imu" and stretch is not None:
            self._follow(stretch)
        self._newest = (b, self.track.pose(stamp))
        self.track.protect()
        window = self._waiting.window(stamp)
        others = (
            [Offer("", Measurement(stamp, self._imu))] if stretch is not None and self._imu != driver else []
        )
        delta += Delta(self._edges_beside()) + self._factors(others + window, a, b, delta.values)
        updates = self._update(b, delta, [b], window)
        self._begun(b, stretch)
        return updates

    def _start(self, stamp: int) -> tuple[Keyframe, Delta]:
        """The first keyframe, turned as far as anything tells."""
        if self._coaster:
            return self._growth.start(stamp, self.track.pose(stamp))
        if self._inertial:
            return self._growth.start(stamp, self._inertial.level(), TILT)
        return self._growth.start(stamp)

    def _edges_beside(self) -> tuple[Factor, ...]:
        """By the odometries that do not drive."""
        keyframes, context = self.timeline.keyframes, self._context({})
        return tuple(edge for each in self._beside.values() for edge in each.edges(keyframes, context))

    def _stretched(self, stamp: int) -> Stretch | None:
        """What the IMU measured since the newest keyframe."""
        if self._inertial is not None:
            self._stretch = self._inertial.cut(stamp)
            self._decisions += self._inertial.take_decisions()
        return self._stretch

    def _begun(self, b: Keyframe, stretch: Stretch | None) -> None:
        """The IMU goes on from a new keyframe; from the one before, if that was taken back."""
        self._stretch = None
        if self._inertial is None:
            return
        if self.timeline.at(b.stamp) is not b:
            self._inertial.lose(stretch)
            return
        driven = stretch.end if stretch is not None and self._imu == self._driver else None
        self._inertial.begin(self._state(b) or driven, b.stamp)

    def _follow(self, stretch: Stretch) -> None:
        """The track goes where the IMU leads."""
        there, end = self.space.identity if self._newest is None else self._newest[1], stretch.end
        if stretch.start is None:
            self.track.add(end.stamp, end.pose)
        elif end.stamp != self.track.newest:
            self.track.add(end.stamp, there.compose(stretch.start.pose.between(end.pose)))

    def _state(self, keyframe: Keyframe) -> State | None:
        """What is believed of a keyframe that has velocity and bias."""
        estimate, v, b = self._applier.estimate, velocity_key(keyframe), bias_key(keyframe)
        if estimate is None or not (estimate.knows(v) and estimate.knows(b)):
            return None
        return State(keyframe.stamp, estimate.pose(keyframe.pose), estimate.value(v), estimate.value(b))

    def _close(self, last: bool = False) -> list[Update]:
        """Without odometry: the measurements of one stamp are complete; their edges make the keyframes.

        last: the input has ended; what is newer than the newest keyframe lands now or never.
        """
        before = len(self.timeline)
        growth, edges = self._growth.along(self._waiting.of(str(self._driver)), self._context)
        new = self.timeline.keyframes[before:]
        a = self._newest[0] if self._newest else None
        b = max(new, key=lambda k: k.stamp, default=a)
        if b is not None and (a is None or b.stamp > a.stamp):
            self._newest = (b, self.track.pose(b.stamp))
        window = edges + (
            self._waiting.window(FAR if last else self._newest[0].stamp) if self._newest else []
        )
        if b is None or not window:
            self._decisions += growth.decisions
            return []
        return self._update(b, growth + self._factors(window, a, b, growth.values), new, window)

    def _factors(
        self, window: Sequence[Offer], a: Keyframe | None, b: Keyframe, guesses: Mapping[int, Any]
    ) -> Delta:
        """Ask each sensor, in the order of the configuration, for the factors of its part of the window."""
        if not window:
            return Delta()
        by_source: dict[str, list[Offer]] = defaultdict(list)
        for offer in window:
            by_source[offer.measurement.source].append(offer)
        deltas: list[Delta] = []
        for name, source in self.config.sources.items():
            if name in by_source:
                context, offers = self.calibration.context(self._context(guesses), name), by_source[name]
                if associator := self._associators.get(name):
                    offers, decisions = associator.named(offers, a, b, context)
                    offers, refused = self._quarantine.let_in(offers, self._landmarks)
                    self._decisions += decisions + refused
                self.calibration.keep(offers)
                deltas.append(SENSORS[source.kind].factors(offers, a, b, context, source))
                guesses = {**guesses, **deltas[-1].values}  # what one has found is there for the next
        return total(deltas)

    def _context(self, guesses: Mapping[int, Any]) -> Context:
        return Context(
            self.space,
            self._applier.estimate,
            guesses,
            self._mounts,
            lambda stamp: self.timeline.place(stamp, self.tracks.of(stamp) or self.track, self.space),
            self.track.motion,
            self.landmark,
            self.parts.of,
            self._waiting.for_variable,
            self._earth,
            self.origin,
            self._gauge,
            DATUM in self.solver.factors,
            self._stretch,
            self._imu == self._driver,
            kept=self.solver.factors.__contains__,
            cameras=self._cameras,
            memory=self._memory,
            tag=self._tag,
        )

    def _takes(self, fix: Fix) -> bool:
        """Book a fix; whether it is to be used."""
        source = self.config.sources.get(fix.source)
        self.origin = self.origin or tuple(fix.place.tolist())
        return not isinstance(source, GnssSource) or self.fixes.add(fix, source)

    def _gauge(self, key: int) -> str | None:
        """What holds the part of a variable, where the earth may take its place: nothing else will say where the map lies."""
        part = self.parts.of(key)
        others = self.parts.home is not None or any(s.kind == "pose" for s in self.config.sources.values())
        return None if others or part is None or not self.parts.is_loose(part) else self.parts.gauge(part)

    def landmark(self, name: str) -> int:
        """The key of a landmark by its name; a new name gets a new key."""
        return self._landmarks.setdefault(name, landmark_key(len(self._landmarks)))

    def _tag(self, name: str) -> int:
        return self._landmarks.setdefault(name, tag_key(len(self._landmarks)))

    def _carry_out(self, command: Command) -> list[Update]:
        """What a person asks; what came of it is a decision, told with the newest keyframe."""
        self._editor.note(self._decisions)
        newest = self._newest[0] if self._newest else None
        decision = Decision(
            newest.stamp if newest else 0, f"command/{command.id}", command.source,
            "accepted", "command", command.action,
        )  # fmt: skip
        try:
            plan, decisions = self._editor.carry_out(command)
            self._revision += plan.revised
            self._decisions += decisions
            decision = replace(decision, basis={**plan.told, "revision": self._revision})
        except SlamError as error:
            decision = replace(decision, verdict="refused", detail=str(error))
        self._decisions.append(decision)
        return [self._told(newest)] if newest else []

    def dry_run(self, action: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """What a command would come to; nothing is touched. SlamError where it would be refused."""
        self._editor.note(self._decisions)
        return {**self._editor.plan(action, arguments).told, "revision": self._revision}

    @property
    def wishes(self) -> Wishes:
        """What a person has decided about single factors."""
        return self._editor.wishes

    # -- the way of a change ---------------------------------------------------------------------

    def _update(
        self, b: Keyframe, delta: Delta, new: Sequence[Keyframe], window: Sequence[Offer]
    ) -> list[Update]:
        """Solve: motion and all that nothing judges first, then what the robust stages let in."""
        delta += Delta(tuple(priors(self._floor, new)))
        self._decisions += delta.decisions
        self._decisions += [told for each in delta.waits for told in self._waiting.wait(each)]
        window = [*window, *self._waiting.landed(delta.values, {factor.id for factor in delta.add})]
        judged = tuple(factor for factor in delta.add if self.jury.judges(factor.kind))
        sure = without(delta, {factor.id for factor in judged})
        try:
            self._applier.apply(sure)
            if self.jury:
                late = {key: guess for key, guess in delta.values.items() if key not in sure.values}
                self._hear(Delta(judged, values=late))
            self._reunite()
            if self.calibration.is_due(len(self.timeline)):
                self._calibrate(b.stamp)
        except SolverFailure:
            self._give_up(delta, new, window)
        return [self._told(b, delta.values.get(b.pose))] if self.timeline.at(b.stamp) is b else []

    def _book(self, delta: Delta) -> None:
        """What the solver has taken, for those who keep books on it."""
        if self._is_judged:
            self._paths.book(delta)
            self._quarantine.book(delta)
            self._budget.book(delta)
        if delta.remove:
            for key in self._quarantine.left(self.estimate.knows):
                self.parts.drop(key)

    def _calibrate(self, stamp: int) -> None:
        """Estimate the constants of the sensors with the graph, and put better ones in force: in what is there and what will come.

        Variables are moved only where iSAM2 would not follow by itself.
        """
        believed = self.estimate.values()
        vector, values, decisions = self.calibration.estimate(
            self.solver.factors, believed, self._with, stamp
        )
        self._decisions += decisions
        if not self.calibration.matters(vector):
            return
        made, found = self._with(vector, vector), {}
        if np.abs(believed.localCoordinates(values).vector()).max() > self.config.isam2.relinearize_threshold:
            found = {key: value_in(self.space, values, key) for key in values.keys()}  # noqa: SIM118  # gtsam's Values
        if self._applier.renew(Delta(tuple(made.values()), tuple(made), found)):
            self.calibration.take(vector)
            self._waiting.late = self.calibration.late

    def _with(self, constants: Array, anchor: Array) -> dict[str, Factor]:
        """The factors in the graph that rest on constants of their sensors, made with these. anchor: see Calibration.context."""
        found: dict[str, Factor] = {}
        for name in sorted(self.calibration.sources):
            settings = self.config.sources[name]
            context = self.calibration.context(self._context({}), name, constants, anchor)
            make, last = SENSORS[settings.kind].factors, self.timeline.keyframes[-1]
            if name == self._driver and not self._coaster:
                deltas = [make([offer], a, b, context, settings) for offer, a, b in self._steps(name)]
            else:
                landed = [offer for offer in self.calibration.offers(name) if offer.id in self.solver.factors]
                deltas = [make(landed, None, last, context, settings)]
            made = (factor for delta in deltas for factor in delta.add)
            found |= {factor.id: factor for factor in made if factor.id in self.solver.factors}
        return found

    def _steps(self, name: str) -> Iterator[tuple[Offer, Keyframe, Keyframe]]:
        """What the motion factors of a source were made from."""
        for factor in self.solver.factors.values():
            if factor.kind == "motion" and factor.source == name:
                a, b = (self.timeline.keyframes[symbolIndex(key)] for key in factor.keys)
                yield Offer("", Measurement(b.stamp, name)), a, b

    def _reunite(self) -> None:
        """Join parts that have come to know enough of the same landmarks."""
        while waits := self._waiting.for_a_joint():
            found = reunion(self.space, waits, self.estimate, self.parts.of)
            if found is None or not self._applier.join(
                found.part, found.to, found.shift, self._common(found)
            ):
                return

    def _common(self, found: Reunion) -> tuple[Factor, ...]:
        """The factors of the sightings that join two parts."""
        self._waiting.used(found.waits)
        by_source: dict[str, list[Offer]] = defaultdict(list)
        for wait in found.waits:
            by_source[wait.offer.measurement.source].append(wait.offer)
        context = replace(self._context({}), component=lambda _: found.to)
        deltas = [
            SENSORS["landmark"].factors(
                offers,
                None,
                self.timeline.keyframes[-1],
                self.calibration.context(context, name),
                self.config.sources[name],
            )
            for name, offers in by_source.items()
        ]
        self._decisions += [decision for delta in deltas for decision in delta.decisions]
        return tuple(factor for delta in deltas for factor in delta.add)

    def _hear(self, proposed: Delta) -> None:
        """The robust stages judge. What was decided before goes first: a person's wishes rest on all of it."""
        self._editor.note(self._decisions)
        try:
            self.jury.hear(proposed)
        finally:
            self._decisions += self.jury.take_decisions()

    def _give_up(self, delta: Delta, new: Sequence[Keyframe], window: Sequence[Offer]) -> None:
        """Not even the motion could be solved: the keyframes are taken back. The next one spans the gap, and takes what
        else was to land here.
        """
        estimate = self._applier.estimate
        for each in self._beside.values():
            each.rewind()
        for gone in reversed(new):
            if estimate is None or not estimate.knows(gone.pose):
                self.timeline.drop(gone)
                self.parts.drop(gone.pose)
        last = self.timeline.newest
        self._newest = (last, self.track.pose(last.stamp)) if last else None
        refused = {d.id for d in (*self._decisions, *self._applier.decisions) if d.verdict == "refused"}
        lost = {factor.id for factor in delta.add} - refused - self.solver.factors.keys()
        self._waiting.again([offer for offer in window if offer.id in lost])

    def _told(self, b: Keyframe, guess: Pose | None = None) -> Update:
        """The update for the newest keyframe, with the decisions since the last one."""
        pose = self.estimate.pose(b.pose)
        if guess is not None:
            self._revision += Shift(*self.space.size(guess.between(pose))).noticeable
        correction = pose.compose(self.track.pose(b.stamp).inverse())
        decisions = (*self._decisions, *self._applier.take_decisions())
        self._decisions = []
        self._editor.note(decisions)
        sevens = self.space.seven(pose), self.space.seven(correction)
        state = self._state(b) if self._imu else None
        told = () if state is None else (*state.velocity.tolist(), *state.bias.vector().tolist())
        return Update(b, *sevens, self._revision, decisions, self._origin, told)


def _stages(config: Config, paths: Paths, quarantine: Quarantine, budget: Budget) -> list[Robust]:
    """What judges factors: loops as the configuration says, fixes on the earth and landmarks always."""
    landmarks = any(isinstance(source, LandmarkSource) for source in config.sources.values())
    fixes = any(isinstance(source, GnssSource) for source in config.sources.values())
    return [
        *(ROBUST[name](config, paths) for name in config.robust),
        *([Doubt(config, paths)] if fixes else []),
        *([quarantine] if landmarks else []),
        *([budget] if landmarks and config.budget.sightings else []),
    ]
