"""Motion where nothing measures it: between fixes, or absolute poses, the robot is thought to go on at constant velocity.

Velocity comes from a Kalman filter on the positions so far, under white noise on the acceleration (Barfoot, State Estimation for
Robotics, 2017, ch. 11). A step is what it predicts before the next position is looked at, so that no position is used twice: once as the
measurement that it is, and never as motion. The robot looks where it goes; a robot that stands has the heading that it had, and one that
has never moved has none.
"""

from dataclasses import dataclass, replace
from math import atan2, cos, hypot, pi, sin, sqrt

import numpy as np

from .config import Coast, Config, Earth, Floor, GnssSource, OdometrySource, PoseSource
from .context import Context, pose_covariance
from .firewall.rules import decided
from .graph import Decision, Pose
from .keyframes import LOST
from .measurement import SECOND, Array, Measurement
from .robust.chi2 import chi2_quantile
from .sensors.gnss import Fix, enu, stated
from .sensors.pose import AbsolutePose
from .space import Space

NAME = "coast"  # whose the motion is
CERTAIN = 3.0  # standard deviations by which a velocity must differ from zero to have a course
PROBABILITY = 0.9999  # with which a true position is used
AGREEING = 3  # positions in a row that fit each other and not the filter make it begin anew
NOISE = OdometrySource(noise="twist")  # of the track: the covariance of each step is told


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A position (n,) in m on axes that do not turn, its covariance, and the rotation (n, n) of the base there with its variance in
    rad^2, if it is told.
    """

    item: Measurement
    place: Array
    covariance: Array
    rotation: Array | None = None
    turned: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """Of the track: `odom_T_base` at a stamp, and the covariance of the motion since the last one at its tangent.

    leaps: the motion is not smooth there: a heading was found, or the filter began anew. Keyframes must stand at both ends.
    """

    stamp: int
    pose: Pose
    covariance: Array
    leaps: bool = False


class Coaster:
    """Of the source that drives; takes what it says in order of stamps."""

    def __init__(self, space: Space, config: Coast) -> None:
        self._space, self._config, self._n = space, config, space.point_dimension
        self._first: Sight | None = None  # until another one agrees with it
        self._stamp = 0
        self._state, self._covariance = (
            np.zeros(0),
            np.zeros((0, 0)),
        )  # position and velocity; their covariance
        self._pose = space.identity
        self._heading: int | None = None  # the stamp when it was last known
        self._strays: list[Sight] = []
        self._decisions: list[Decision] = []

    def take_decisions(self) -> list[Decision]:
        taken, self._decisions = self._decisions, []
        return taken

    def add(self, sight: Sight) -> list[Step]:
        """Where that brings the track. Nothing, while there is only one position, or the two newest cannot both be right."""
        if len(self._state):
            return [self._follow(sight)] if sight.item.stamp > self._stamp else []
        first, self._first = self._first, sight
        if first is None or not self._agree(first, sight):
            return []
        self._begin(first, sight)
        start = Step(first.item.stamp, self._turned(first), np.zeros((self._space.dimension,) * 2))
        self._pose, self._stamp = start.pose, start.stamp
        if self._heading is None:
            self._decisions.append(decided(first.item, "accepted", "coast/no_heading"))
        # What the second position says of the velocity has been used up by the first step: that is as wide as a guess.
        loose = (self._config.max_speed * (sight.item.stamp - first.item.stamp) / SECOND) ** 2
        step = self._step(sight, np.eye(self._n) * loose)
        self._begin(first, sight)
        return [start, step]

    def _begin(self, first: Sight, second: Sight) -> None:
        """The filter, from two positions."""
        seconds = (second.item.stamp - first.item.stamp) / SECOND
        n, noise = self._n, self._noise(seconds)
        self._stamp = second.item.stamp
        self._state = np.concatenate([second.place, (second.place - first.place) / seconds])
        self._covariance = np.zeros((2 * n, 2 * n))
        self._covariance[:n, :n] = second.covariance
        self._covariance[:n, n:] = self._covariance[n:, :n] = second.covariance / seconds
        self._covariance[n:, n:] = (first.covariance + second.covariance) / seconds**2 + noise[n:, n:]
        self._strays = []

    def _agree(self, one: Sight, other: Sight) -> bool:
        """Whether a robot can have been at both."""
        seconds = (other.item.stamp - one.item.stamp) / SECOND
        sigma = float(np.sqrt(np.trace(one.covariance + other.covariance)))
        reach = self._config.max_speed * seconds + CERTAIN * sigma
        return seconds > 0 and float(np.linalg.norm(other.place - one.place)) <= reach

    def _follow(self, sight: Sight) -> Step:
        """Predict, step, and only then look at the position."""
        n, seconds = self._n, (sight.item.stamp - self._stamp) / SECOND
        ahead = np.eye(2 * n)
        ahead[:n, n:] = np.eye(n) * seconds
        velocity, noise = self._covariance[n:, n:], self._noise(seconds)
        moved = velocity * seconds**2 + noise[:n, :n]
        state = ahead @ self._state
        covariance = ahead @ self._covariance @ ahead.T + noise
        innovation = sight.place - state[:n]
        gain = np.linalg.solve(covariance[:n, :n] + sight.covariance, covariance[:n]).T
        nis = float(innovation @ np.linalg.solve(covariance[:n, :n] + sight.covariance, innovation))
        if nis > chi2_quantile(PROBABILITY, n):
            if self._is_astray(sight):
                self._decisions.append(decided(sight.item, "accepted", "coast/restart", sqrt(nis)))
                step = self._step(sight, moved + np.outer(innovation, innovation))
                self._begin(*self._strays[-2:])
                return replace(step, leaps=True)
        else:
            self._strays = []
        step = self._step(sight, moved)
        self._state, self._covariance = state, covariance
        if not self._strays:
            self._state = state + gain @ innovation
            self._covariance = covariance - gain @ covariance[:n]
        return step

    def _is_astray(self, sight: Sight) -> bool:
        """Whether this is one of enough positions that agree with each other, and not with the filter."""
        if self._strays and not self._agree(self._strays[-1], sight):
            self._strays = []
        self._strays.append(sight)
        return len(self._strays) >= AGREEING

    def _step(self, sight: Sight, moved: Array) -> Step:
        """At the velocity so far; moved: covariance of the displacement on the axes of the positions."""
        seconds, velocity = (sight.item.stamp - self._stamp) / SECOND, self._state[self._n :]
        known, before = self._heading, self._pose
        turned = self._turned(sight)
        if self._heading is None:  # a way without a direction: else it would tell a heading
            moved, velocity = moved + np.eye(self._n) * float(velocity @ velocity) * seconds**2, 0 * velocity
        pose = self._space.rigid(turned.rotation().matrix(), before.translation() + velocity * seconds)
        variance = pi**2 if self._heading is None else self._config.turn_rate**2 * seconds
        if self._heading == sight.item.stamp:  # it may have turned while nobody could tell
            blind = (
                pi**2 if known is None else self._config.turn_rate**2 * (sight.item.stamp - known) / SECOND
            )
            variance = max(variance, blind)
        found = known is None and self._heading is not None
        wide = sight.turned * float(velocity @ velocity) * seconds**2
        to_base = pose.rotation().matrix().T
        covariance = self._space.diagonal(min(variance + sight.turned, LOST**2), 0.0).copy()
        at = self._space.translation
        covariance[at, at] = to_base @ (moved + np.eye(self._n) * wide) @ to_base.T
        self._pose, self._stamp = pose, sight.item.stamp
        return Step(self._stamp, pose, covariance, found)

    def _turned(self, sight: Sight) -> Pose:
        """With the rotation that is told, else that of the course, else the one before."""
        rotation, n = sight.rotation, self._n
        if rotation is None:
            east, north = self._state[n : n + 2]
            speed = hypot(east, north)
            if speed <= CERTAIN * sqrt(np.linalg.eigvalsh(self._covariance[n : n + 2, n : n + 2])[-1]):
                return self._pose
            course = atan2(north, east)
            rotation = np.eye(n)
            rotation[:2, :2] = ((cos(course), -sin(course)), (sin(course), cos(course)))
        self._heading = sight.item.stamp
        return self._space.rigid(rotation, self._pose.translation())

    def _noise(self, seconds: float) -> Array:
        """(2n, 2n) of position and velocity after so long, by white noise on the acceleration."""
        block = np.array([[seconds**3 / 3, seconds**2 / 2], [seconds**2 / 2, seconds]])
        return np.asarray(np.kron(block, np.eye(self._n)) * self._config.acceleration**2)


def sight_of(item: Fix | AbsolutePose, context: Context, config: GnssSource | PoseSource) -> Sight:
    """Unusable where its frame is unknown. The lever arm of an antenna is left out: only differences count."""
    space, n = context.space, context.space.point_dimension
    if isinstance(item, Fix):
        assert isinstance(config, GnssSource)
        assert context.origin is not None
        return Sight(item, enu(item.place, context.origin)[:n], stated(item, config)[:n, :n])
    assert isinstance(config, PoseSource)
    mount, pose = context.mount(item.frame), space.pose(item.pose.tolist())
    covariance = pose_covariance(
        space, item.covariance, pose, config.sigma_rotation, config.sigma_translation
    )
    rotation = pose.rotation().matrix()
    at = space.translation
    turns = np.delete(np.diag(covariance), np.r_[at])
    base = pose.compose(mount.inverse())
    return Sight(
        item, np.array(base.translation()), rotation @ covariance[at, at] @ rotation.T,
        base.rotation().matrix(), float(turns.max()),
    )  # fmt: skip


def coasts(config: Config) -> bool:
    """Whether nothing measures the motion."""
    return isinstance(config.sources[config.driver or ""], GnssSource | PoseSource)


def earth_from(config: Config) -> Earth:
    """Where positions drive, the map lies as the earth does: its yaw is not looked for, that of the robot is free."""
    return config.earth.model_copy(update={"yaw": 0.0, "sigma_yaw": pi}) if coasts(config) else config.earth


def floor_from(config: Config) -> Floor:
    """Nothing else tells roll and pitch."""
    if config.space == "2d" or config.floor.tilt is not None or not coasts(config):
        return config.floor
    return config.floor.model_copy(update={"tilt": config.coast.tilt})
