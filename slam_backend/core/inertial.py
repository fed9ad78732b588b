"""The IMU since the newest keyframe: preintegrated, and where that leads.

A sample holds from the stamp of the one before it to its own. Preintegration is that of Forster et al., "On-Manifold
Preintegration for Real-Time Visual-Inertial Odometry", T-RO 2017, in GTSAM's combined form, whose covariance includes the random walk
of the biases.
"""

from bisect import bisect_right
from dataclasses import dataclass
from math import atan2, hypot, inf, sqrt
from operator import attrgetter

import gtsam
import numpy as np

from .config import Config, ImuNoise, ImuSource, Keyframes
from .firewall.rules import decided
from .graph import Decision, Motion, Pose, Verdict
from .measurement import SECOND, Array, ImuSample, Measurement
from .symptoms import Symptoms

Bias = gtsam.imuBias.ConstantBias

KEPT = 4096  # samples since the newest keyframe, for one that is asked for in the past
INTEGRATION = (
    1e-4  # m per root second, of the integration itself: without it the covariance of one sample is singular
)
PERIOD = 0.01  # s between samples, before two of them have told
STILL_RATE, STILL_ACCELERATION = 0.006, 0.06  # rad/s, m/s^2: largest standard deviations of an IMU at rest
LARGEST_BIAS = 0.1  # rad/s: a mean rate that may still be the bias of an IMU at rest
ENOUGH = 5  # samples, to tell by their looks whether the robot stands still
ODD = 0.5  # of gravity: what the first samples may differ from it
SIDEWAYS = 0.8  # rad: a robot is not tilted so much where it starts; an IMU whose mounting nobody told is
UNMEASURED = 3.0, 0.5  # m/s^2, rad/s: how the robot may have moved while its IMU did not tell
GUESSED = 0.1  # m/s: of the velocity, in the covariance of a motion that is told without its velocity
UNIT3, UNIT6 = np.eye(3), np.eye(6)  # asked for at every keyframe


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """`map_T_base`, velocity (3,) m/s in the map, and bias of the IMU in its own frame, at a stamp (ns)."""

    stamp: int
    pose: Pose
    velocity: Array
    bias: Bias


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """From one keyframe to the next.

    start: the state it begins with; None where the keyframe has none. end: where it leads. measured: preintegrated.
    flaw: the rule by which `measured` must not be used; empty if it may. rest: seconds that the robot stood still before the first keyframe.
    """

    start: State | None
    end: State
    measured: gtsam.PreintegratedCombinedMeasurements
    flaw: str = ""
    rest: float = 0.0

    @property
    def seconds(self) -> float:
        return 0.0 if self.start is None else (self.end.stamp - self.start.stamp) / SECOND

    @property
    def pose(self) -> Pose:
        """`start_T_end`."""
        assert self.start is not None
        return self.start.pose.between(self.end.pose)

    @property
    def motion(self) -> Motion:
        """The same for who knows no velocities: with a covariance that makes up for it."""
        pose = self.pose
        if self.flaw:
            acceleration, rate = UNMEASURED
            meters = acceleration * self.seconds**2 / 2 + GUESSED * self.seconds
            return Motion(pose, np.diag(np.square([rate * self.seconds] * 3 + [meters] * 3)))
        covariance = self.measured.preintMeasCov()[:6, :6].copy()
        covariance[3:, 3:] += UNIT3 * (GUESSED * self.seconds) ** 2
        turn = UNIT6.copy()
        turn[3:, 3:] = pose.rotation().matrix().T  # positions are told in the axes of the start
        return Motion(pose, turn @ covariance @ turn.T)


class Inertial:
    """Takes samples in order of their stamps; is asked for the stretch up to a keyframe, and told what is believed there."""

    def __init__(self, source: str, config: ImuSource) -> None:
        self._source, self._config, self._stated = source, config, config.stated
        self._longest = config.max_gap * SECOND  # ns
        self._symptoms = Symptoms(config)
        self._samples: list[
            ImuSample
        ] = []  # since the newest keyframe; before the first, of the last seconds
        self._next = 0  # the first of them that is not integrated
        self._before: ImuSample | None = None  # the sample before them
        self._newest: ImuSample | None = None  # of all
        self._cuttable = 0  # before this stamp no keyframe can be made any more
        self._mount: Pose | None = None
        self._params: gtsam.PreintegrationCombinedParams | None = None  # of that mount, and of
        self._noise: ImuNoise | None = None
        self._start: State | None = None  # at the newest keyframe
        self._from: State | None = None  # where preintegration began: there, or behind a gap
        self._origin = gtsam.NavState()  # the same, for gtsam
        self._measured: gtsam.PreintegratedCombinedMeasurements | None = None  # since then
        self._at = 0  # stamp up to which it goes
        self._flaw = ""
        self._bias = Bias()  # last believed
        self._period = PERIOD  # s between the newest two samples
        self._decisions: list[Decision] = []

    def take_decisions(self) -> list[Decision]:
        taken, self._decisions = self._decisions, []
        return taken

    # -- samples ---------------------------------------------------------------------------------

    def add(self, sample: ImuSample, mount: Pose | None) -> None:
        """mount: `base_T_sensor`; None where the sensor's frame is the base."""
        if mount is not self._mount:
            self._mount, self._params = mount, None
        if self._from is None:
            self._collect(sample)
        before = self._newest or sample
        if 0 < (elapsed := sample.stamp - before.stamp) <= self._longest:
            self._period = elapsed / SECOND
        if (stuck := self._symptoms.compare(sample, before)) is not None:
            self._decide(sample.stamp, "accepted", "imu/stuck", stuck)
        self._newest = sample
        self._samples.append(sample)
        if len(self._samples) > KEPT:
            self._integrate(self._samples[KEPT // 2].stamp)
            self._drop(KEPT // 2)
            self._cuttable = self._at

    def _collect(self, sample: ImuSample) -> None:
        """Before the first keyframe: the samples of the last seconds, without a gap between them."""
        if self._samples and sample.stamp - self._samples[-1].stamp > self._longest:
            self._drop(len(self._samples))
        while self._samples and sample.stamp - self._samples[0].stamp > self._config.start_time * SECOND:
            self._drop(1)

    def _drop(self, count: int) -> None:
        if count:
            self._before = self._samples[count - 1]
            del self._samples[:count]
            self._next = max(self._next - count, 0)

    @property
    def ready(self) -> int | None:
        """Stamp of the first sample once there are enough to begin with."""
        full = 0.9 * self._config.start_time * SECOND
        if not self._samples or self._samples[-1].stamp - self._samples[0].stamp < full:
            return None
        return self._samples[0].stamp

    def level(self) -> Pose:
        """`map_T_base` at the origin, without yaw, as gravity in the samples so far turns it."""
        if not self._samples:
            return gtsam.Pose3()
        up = np.mean([sample.acceleration for sample in self._samples], axis=0)
        x, y, z = up if self._mount is None else self._mount.rotation().matrix() @ up
        return gtsam.Pose3(gtsam.Rot3.RzRyRx(atan2(y, z), atan2(-x, hypot(y, z)), 0.0), np.zeros(3))

    # -- keyframes -------------------------------------------------------------------------------

    def cut(self, stamp: int, turned: float | None = None) -> Stretch | None:
        """From the newest keyframe to this stamp. None where the IMU tells nothing there. turned: rad, by the odometry."""
        if not self._is_alive(stamp):
            self._fall_silent(stamp)
            return None
        if self._from is None:
            return self._first(stamp)
        if stamp < self._at:
            self._begin_again(stamp)
        self._integrate(stamp)
        if turned is not None and self._symptoms.doubts_turns:
            self._compare_turns(stamp, turned)
        if self._flaw:
            start = stamp if self._start is None else self._start.stamp
            self._decide(stamp, "refused", self._flaw, (stamp - start) / SECOND)
        assert self._measured is not None
        return Stretch(self._start, self.predicted, self._measured, self._flaw)

    def _compare_turns(self, stamp: int, turned: float) -> None:
        if self._start is not None:
            since = bisect_right(self._samples, self._start.stamp, key=attrgetter("stamp"))
            rates = [sample.rate for sample in self._samples[since:]]
            self._symptoms.compare_turns(rates, (stamp - self._start.stamp) / SECOND, turned)
        if self._symptoms.in_degrees:
            self._flaw = "imu/degrees"

    def begin(self, state: State | None, stamp: int) -> None:
        """A keyframe is there. state: what is believed of it; None if it has no velocity and bias."""
        self._drop(bisect_right(self._samples, stamp, key=attrgetter("stamp")))
        self._next, self._at, self._flaw = 0, stamp, ""
        self._start = self._from = state
        if state is not None:
            self._bias = state.bias
            self._renew(state)

    def lose(self, stretch: Stretch | None) -> None:
        """The keyframe was taken back: the next stretch begins where this one did, and cannot be used."""
        if stretch is not None and self._from is not None:
            self._from, self._flaw = stretch.end, "imu/gap"
            self._renew(stretch.end)

    @property
    def predicted(self) -> State:
        """Where the samples that are integrated lead."""
        assert self._from is not None
        found = self._led()
        return State(self._at, found.pose(), np.asarray(found.velocity()), self._from.bias)

    def _led(self) -> gtsam.NavState:
        assert self._from is not None
        assert self._measured is not None
        return self._measured.predict(self._origin, self._from.bias)

    def moved(self, stamp: int) -> Pose:
        """`keyframe_T_stamp`, to a stamp that is not older than what is integrated."""
        self._integrate(stamp)
        assert self._start is not None
        return self._start.pose.between(self._led().pose())

    def since(self, stamp: int) -> Stretch:
        """From the newest keyframe to such a stamp, as it is now: a keyframe may still cut it."""
        self._integrate(stamp)
        assert self._measured is not None
        return Stretch(self._start, self.predicted, self._measured, self._flaw)

    # -- integration -----------------------------------------------------------------------------

    def _integrate(self, until: int) -> None:
        """A sample holds back to the one before it; beyond the last one, that holds on."""
        if self._from is None:
            return
        samples, before = self._samples, self._sample(self._next - 1)
        while self._next < len(samples) and (sample := samples[self._next]).stamp <= until:
            self._move(sample, before, sample.stamp)
            before = sample
            self._next += 1
        if self._at < until:
            last = min(self._next, len(samples) - 1)
            self._move(self._sample(last), self._sample(last - 1), until)

    def _move(self, sample: ImuSample, before: ImuSample, until: int) -> None:
        """sample: the one that holds until then. before: the one before it."""
        seconds = (until - self._at) / SECOND
        if max(sample.stamp - before.stamp, until - sample.stamp) > self._longest:
            self._coast(until)
        elif seconds > 0:
            self._flaw = self._symptoms.flaw(sample) or self._flaw
            assert self._measured is not None
            self._measured.integrateMeasurement(sample.acceleration, sample.rate, seconds)
            self._at = until

    def _sample(self, n: int) -> ImuSample:
        if n >= 0:
            return self._samples[n]
        return self._before or self._samples[0]

    def _coast(self, until: int) -> None:
        """Over a gap at constant velocity."""
        state = self.predicted
        seconds = (until - self._at) / SECOND
        pose = gtsam.Pose3(state.pose.rotation(), state.pose.translation() + seconds * state.velocity)
        self._from = State(until, pose, state.velocity, state.bias)
        self._at, self._flaw = until, "imu/gap"
        self._renew(self._from)

    def _begin_again(self, stamp: int) -> None:
        """For a keyframe in the past: from the newest one on."""
        assert self._start is not None
        flaw = "imu/gap" if stamp < self._cuttable else ""
        self._from, self._next, self._at, self._flaw = self._start, 0, self._start.stamp, flaw
        self._renew(self._start)

    def _renew(self, state: State) -> None:
        noise = self._told()
        if self._params is None or noise != self._noise:
            self._params, self._noise = parameters(self._config, noise, self._mount), noise
        self._origin = gtsam.NavState(state.pose, state.velocity)
        self._measured = gtsam.PreintegratedCombinedMeasurements(self._params, state.bias)

    def _told(self) -> ImuNoise:
        """As configured; by the newest sample where the messages are to tell, and do."""
        stated, config, newest = self._stated, self._config, self._newest
        if config.noise == "preset" or newest is None:
            return stated
        period = self._period
        rate = _variance(newest.rate_covariance) if config.gyroscope_density is None else None
        acceleration = (
            _variance(newest.acceleration_covariance) if config.accelerometer_density is None else None
        )
        if rate is not None:
            stated = stated._replace(gyroscope_density=sqrt(rate * period))
        if acceleration is not None:
            stated = stated._replace(accelerometer_density=sqrt(acceleration * period))
        return stated

    # -- the first keyframe, and silence ---------------------------------------------------------

    def _first(self, stamp: int) -> Stretch | None:
        """What the samples before the first keyframe tell; None where they cannot be right."""
        rates = np.array([sample.rate for sample in self._samples])
        accelerations = np.array([sample.acceleration for sample in self._samples])
        gravity = float(np.linalg.norm(accelerations.mean(axis=0)))
        if not abs(gravity / self._config.gravity - 1) < ODD:
            self._decide(stamp, "refused", "imu/gravity", gravity, self._config.gravity)
            self._drop(len(self._samples))
            return None
        seconds = (self._samples[-1].stamp - self._samples[0].stamp) / SECOND
        rest = self._rests(rates, accelerations)
        level = self.level()
        tilt = float(np.arccos(np.clip(level.matrix()[2, 2], -1, 1)))
        self._decide(stamp, "accepted", "imu/at_rest" if rest else "imu/in_motion", seconds)
        if tilt > SIDEWAYS:
            self._decide(stamp, "accepted", "imu/sideways", tilt)
        bias = Bias(np.zeros(3), rates.mean(axis=0)) if rest else self._bias
        end = State(stamp, level, np.zeros(3), bias)
        self._renew(end)
        assert self._measured is not None
        return Stretch(None, end, self._measured, rest=max(seconds, PERIOD) if rest else 0.0)

    def _rests(self, rates: Array, accelerations: Array) -> bool:
        if self._config.start != "auto":
            return self._config.start == "rest"
        return bool(
            len(rates) >= ENOUGH
            and rates.std(axis=0).max() < STILL_RATE
            and accelerations.std(axis=0).max() < STILL_ACCELERATION
            and np.linalg.norm(rates.mean(axis=0)) < LARGEST_BIAS
        )

    def _is_alive(self, stamp: int) -> bool:
        return self._newest is not None and stamp - self._newest.stamp <= self._longest

    def _fall_silent(self, stamp: int) -> None:
        """Only another source can make a keyframe where there are no samples."""
        if self._from is not None:
            self._decide(stamp, "refused", "imu/gap", (stamp - self._at) / SECOND)
        self._drop(len(self._samples))
        self._start = self._from = None

    def _decide(
        self, stamp: int, verdict: Verdict, rule: str, statistic: float, threshold: float | None = None
    ) -> None:
        self._decisions.append(decided(Measurement(stamp, self._source), verdict, rule, statistic, threshold))


def parameters(config: ImuSource, noise: ImuNoise, mount: Pose | None) -> gtsam.PreintegrationCombinedParams:
    """Of the preintegration. mount: `base_T_sensor`; None where the sensor's frame is the base."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(config.gravity)
    params.setGyroscopeCovariance(UNIT3 * noise.gyroscope_density**2)
    params.setAccelerometerCovariance(UNIT3 * noise.accelerometer_density**2)
    params.setBiasOmegaCovariance(UNIT3 * noise.gyroscope_walk**2)
    params.setBiasAccCovariance(UNIT3 * noise.accelerometer_walk**2)
    params.setIntegrationCovariance(UNIT3 * INTEGRATION**2)
    if mount is not None:
        params.setBodyPSensor(mount)
    return params


def _variance(covariance: Array) -> float | None:
    """The mean of the three variances; None where they say nothing."""
    x, y, z = covariance.tolist()[::4]
    return (x + y + z) / 3 if 0 < x < inf and 0 < y < inf and 0 < z < inf else None


def imu_of(config: Config) -> ImuSource | None:
    return next((source for source in config.sources.values() if isinstance(source, ImuSource)), None)


def imu_name(config: Config) -> str:
    """Of the source that `imu_of` tells; empty where there is none."""
    return next((name for name, source in config.sources.items() if isinstance(source, ImuSource)), "")


def pace_from(config: Config) -> Keyframes:
    """When keyframes are due: where no odometry drives, after some time at the latest. Neither an IMU nor constant velocity knows
    enough of how fast the robot is to tell by the distance.
    """
    driver = config.sources[config.driver or ""]
    if isinstance(driver, ImuSource):
        longest = driver.keyframe_time
    elif driver.kind in ("gnss", "pose"):
        longest = config.coast.keyframe_time
    else:
        return config.keyframes
    longest = min(longest, config.keyframes.time or longest)
    return config.keyframes.model_copy(update={"time": longest})
