"""What drives: odometry, the IMU and fixes flow, and are added up until the next keyframe; none of them is kept one by one.

Each takes a measurement and yields the stamps at which keyframes are to be made. A keyframe is made before the next stamp is asked for.
"""

from collections.abc import Iterable, Iterator

from .beside import Beside
from .books import Books
from .coast import Coaster, coasts, sight_of
from .config import GnssSource, OdometrySource, PoseSource
from .context import Unusable, unknown_frame
from .graph import Delta, Factor, Keyframe, Offer, identify
from .growth import TILT, Growth
from .inertial import Inertial, Stretch, imu_of, pace_from
from .keyframes import due
from .measurement import SECOND, ImuSample, Measurement
from .sensing import Sensing
from .sensors.gnss import Fix
from .sensors.odometry import HERE, OdometryPose, stated
from .sensors.pose import AbsolutePose
from .waiting import refusal

STEP = SECOND // 20  # ns between samples of the track where the IMU drives


class Drive:
    """coaster: None where something measures the motion. origin: as of an Update."""

    def __init__(self, books: Books, sensing: Sensing, growth: Growth) -> None:
        config, space = books.config, books.space
        self._books, self._sensing, self._growth = books, sensing, growth
        self._inertial = Inertial(books.imu, imu) if (imu := imu_of(config)) else None
        self._by_imu = books.imu == books.driver
        self._pace = pace_from(config)
        self.coaster = Coaster(space, config.coast) if coasts(config) else None
        self._beside = {
            name: Beside(name, source, space, books.mounts)
            for name, source in config.sources.items()
            if isinstance(source, OdometrySource) and name != books.driver
        }
        self._epoch, self.origin = 0, HERE  # of the driving odometry

    # -- what flows ------------------------------------------------------------------------------

    def takes(self, measurement: Measurement) -> Iterable[int] | None:
        """The stamps of keyframes to make. None: it does not flow, and lands at a keyframe."""
        books = self._books
        if isinstance(measurement, ImuSample):  # the most frequent first
            mine = self._inertial if measurement.source == books.imu else None
            return self._sample(measurement, mine) if mine else None
        if isinstance(measurement, OdometryPose) and measurement.source == books.driver:
            return self._odometry(measurement)
        if isinstance(measurement, OdometryPose) and measurement.source in self._beside:
            books.decisions += self._beside[measurement.source].add(measurement, bool(books.newest))
            return ()
        return None

    def _odometry(self, odometry: OdometryPose) -> Iterator[int]:
        """The driving odometry moves on: keyframes that were asked for, then one of its own if it is due."""
        books, track = self._books, self._books.track
        books.mounts.name_base(odometry.child)
        pose = books.space.pose(odometry.pose.tolist())
        restarted = odometry.epoch != self._epoch and len(track) > 0
        self._epoch, self.origin = odometry.epoch, odometry.origin
        seconds = (odometry.stamp - track.newest) / SECOND if len(track) else 0.0
        noise = stated(books.space, track.noise, odometry, seconds)
        (track.leap if restarted else track.add)(odometry.stamp, pose, noise)
        return self._reached(odometry.stamp, restarted)

    def _reached(self, stamp: int, restarted: bool = False) -> Iterator[int]:
        """The track has come to this stamp: keyframes that were asked for, then one there if it is due."""
        books, track = self._books, self._books.track
        for wanted in books.waiting.asked(stamp):
            if track.covers(wanted) and (books.newest is None or wanted > books.newest[0].stamp):
                yield wanted
        if books.newest is None:
            yield stamp
            return
        newest, there = books.newest
        moved, elapsed = there.between(track.pose(stamp)), stamp - newest.stamp
        if elapsed > 0 and (restarted or due(self._pace, books.space, moved, elapsed)):
            yield from self._due(newest, stamp, restarted)

    def _due(self, newest: Keyframe, stamp: int, restarted: bool = False) -> Iterator[int]:
        """A keyframe is due at this stamp: where the newest image was, if there has been one since the newest keyframe."""
        books = self._books
        at = books.waiting.image(newest.stamp, stamp)
        if at is not None and books.track.covers(at):
            yield at
        if at is None or (at < stamp and (restarted or books.config.keyframes.every)):
            yield stamp

    def _sample(self, sample: ImuSample, inertial: Inertial) -> Iterable[int]:
        """The IMU says something: kept for the next keyframe; where it drives, the track follows."""
        books = self._books
        if self._by_imu:
            books.mounts.name_base(sample.frame)
        mount = books.mounts.get(sample.frame)
        if mount is None:
            why = unknown_frame(sample.frame)
            books.decisions.append(refusal(Offer(identify(sample, 0), sample), "imu", why.reason, why.detail))
            return ()
        inertial.add(sample, None if mount is books.space.identity else mount)
        moves = self._by_imu and (
            books.newest is None
            or sample.stamp - books.track.newest >= STEP
            or books.waiting.wants(sample.stamp)
        )
        return self._propagated(sample, inertial) if moves else ()

    def _propagated(self, sample: ImuSample, inertial: Inertial) -> Iterator[int]:
        books = self._books
        if books.newest is None:
            if (first := inertial.ready) is None:
                return
            yield first
        for wanted in books.waiting.asked(sample.stamp):
            if books.newest and wanted > books.newest[0].stamp:
                yield wanted
        if books.newest and sample.stamp - books.track.newest >= STEP:
            newest, there = books.newest
            moved = inertial.moved(sample.stamp)
            books.track.add(sample.stamp, there.compose(moved))
            if due(self._pace, books.space, moved, sample.stamp - newest.stamp):
                yield from self._due(newest, sample.stamp)

    def coast(self, item: Measurement, coaster: Coaster) -> Iterator[int]:
        """Nothing measures the motion: the track goes on as the positions before this one let expect."""
        assert isinstance(item, Fix | AbsolutePose)
        books = self._books
        books.mounts.name_base(item.frame)
        settings = books.config.sources[item.source]
        assert isinstance(settings, GnssSource | PoseSource)
        try:
            steps = coaster.add(sight_of(item, self._sensing.context({}), settings))
        except Unusable:  # its sensor will say so
            return
        books.decisions += coaster.take_decisions()
        for step in steps:
            if step.leaps and books.newest and books.track.newest > books.newest[0].stamp:
                yield books.track.newest
            books.track.add(step.stamp, step.pose, step.covariance)
            yield from self._reached(step.stamp, step.leaps)

    # -- at a keyframe ---------------------------------------------------------------------------

    def start(self, stamp: int) -> tuple[Keyframe, Delta]:
        """The first keyframe, turned as far as anything tells."""
        if self.coaster:
            return self._growth.start(stamp, self._books.track.pose(stamp))
        if self._inertial:
            return self._growth.start(stamp, self._inertial.level(), TILT)
        return self._growth.start(stamp)

    def stretched(self, stamp: int) -> Stretch | None:
        """What the IMU measured since the newest keyframe."""
        books = self._books
        if self._inertial is not None:
            turned = None
            if not self._by_imu and books.newest is not None:
                turned = books.space.size(books.newest[1].between(books.track.pose(stamp)))[1]
            books.stretch = self._inertial.cut(stamp, turned)
            books.decisions += self._inertial.take_decisions()
        return books.stretch

    def follow(self, stretch: Stretch) -> None:
        """The track goes where the IMU leads."""
        books, end = self._books, stretch.end
        there = books.space.identity if books.newest is None else books.newest[1]
        if stretch.start is None:
            books.track.add(end.stamp, end.pose)
        elif end.stamp != books.track.newest:
            books.track.add(end.stamp, there.compose(stretch.start.pose.between(end.pose)))

    def begun(self, b: Keyframe, stretch: Stretch | None) -> None:
        """The IMU goes on from a new keyframe; from the one before, if that was taken back."""
        books = self._books
        books.stretch = None
        if self._inertial is None:
            return
        if books.timeline.at(b.stamp) is not b:
            self._inertial.lose(stretch)
            return
        driven = stretch.end if stretch is not None and self._by_imu else None
        self._inertial.begin(books.state(b) or driven, b.stamp)

    def edges_beside(self) -> tuple[Factor, ...]:
        """By the odometries that do not drive."""
        if not self._beside:
            return ()
        keyframes, context = self._books.timeline.keyframes, self._sensing.context({})
        return tuple(edge for each in self._beside.values() for edge in each.edges(keyframes, context))

    def rewind(self) -> None:
        """What was made at the newest keyframes did not enter."""
        for each in self._beside.values():
            each.rewind()
