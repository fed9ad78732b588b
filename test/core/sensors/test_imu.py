"""An IMU: between keyframes that odometry makes, and driving them itself."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import ImuSource, config_from
from slam_backend.core.errors import BadConfig
from slam_backend.core.geometry import matrix_of
from slam_backend.core.graph import EARTH, Decision
from slam_backend.core.inertial import Inertial, State
from slam_backend.core.measurement import SECOND, ImuSample, format_stamp, frozen
from slam_backend.core.robust.chi2 import chi2_quantile
from slam_backend.core.sensors.gnss import Fix, geodetic
from slam_backend.core.sensors.imu import bias_key, velocity_key
from slam_backend.core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from slam_backend.core.sensors.pose import AbsolutePose
from slam_backend.core.space import SPACES
from slam_backend.io.replay import settled_stream
from slam_backend.lab.inertia import UNSTATED, erring, felt, velocities
from slam_backend.lab.simulate import Options, simulate

SECONDS, RATE = 15, 50
FLIGHT = Options(poses=2 * SECONDS + 1, period=0.5, imu_rate=RATE, accelerometer_bias=0.1)
QUIET = replace(
    FLIGHT, gyroscope_density=1e-7, accelerometer_density=1e-7, gyroscope_walk=1e-9, accelerometer_walk=1e-9,
    gyroscope_bias=1e-9, accelerometer_bias=1e-9,
)  # fmt: skip
IMU = {
    "kind": "imu", "gyroscope_density": FLIGHT.gyroscope_density, "gyroscope_walk": FLIGHT.gyroscope_walk,
    "accelerometer_density": FLIGHT.accelerometer_density, "accelerometer_walk": FLIGHT.accelerometer_walk,
    "sigma_gyroscope_bias": FLIGHT.gyroscope_bias, "sigma_accelerometer_bias": FLIGHT.accelerometer_bias,
    "start": "motion",
}  # fmt: skip
FIX = 0.1, 0.05  # m and rad, of the absolute poses that are told each second


class Flight:
    """Up a spiral at 1 m/s: samples of an IMU, and the truth behind them."""

    def __init__(self, seed: int = 0, options: Options = FLIGHT, mount: gtsam.Pose3 | None = None) -> None:
        """mount: `base_T_imu`; the samples are then those of an IMU there, in the frame imu_link."""
        made = simulate("spiral", 0, options)
        self.rng = np.random.default_rng(seed)
        self.stamps, self.poses = made.stamps.tolist(), matrix_of(made.sevens)
        there = self.poses if mount is None else self.poses @ mount.matrix()
        exact = felt(there, self.stamps, RATE)
        self.bias, white = erring(len(exact.stamps), 1 / RATE, options, self.rng)
        numbers = np.concatenate([exact.accelerations, exact.rates], axis=1) + self.bias + white
        self.velocities = velocities(self.poses[:, :3, 3], 0.5, RATE // 2)
        frame = "base" if mount is None else "imu_link"
        self.samples = [
            ImuSample(stamp, "imu", frame, frozen(row[3:]), frozen(row[:3]), UNSTATED, UNSTATED)
            for stamp, row in zip(exact.stamps, numbers, strict=True)
        ]

    def fixes(self, every: int = 2) -> list[AbsolutePose]:
        """With the noise that they state."""
        meters, radians = FIX
        sigmas = np.array([radians] * 3 + [meters] * 3)
        found = []
        for stamp, pose in list(zip(self.stamps, self.poses, strict=True))[2::every]:
            seen = gtsam.Pose3(pose).retract(self.rng.standard_normal(6) * sigmas)
            ros = SPACES["3d"].covariance_to_ros(np.diag(sigmas**2), seen)
            found.append(
                AbsolutePose(stamp, "fixes", "", frozen(SPACES["3d"].seven(seen)), frozen(ros.ravel()))
            )
        return found

    def odometry(self, drift: float = 2e-3) -> list[OdometryPose]:
        """Steps of half a second, each a little wrong."""
        pose, found = gtsam.Pose3(), []
        for n, stamp in enumerate(self.stamps):
            if n:
                step = gtsam.Pose3(self.poses[n - 1]).between(gtsam.Pose3(self.poses[n]))
                pose = pose.compose(step.retract(self.rng.standard_normal(6) * drift))
            seven = frozen(SPACES["3d"].seven(pose))
            found.append(OdometryPose(stamp, "wheels", "odom", "base", seven, UNKNOWN, STILL, UNKNOWN))
        return found


def config(*others, imu=IMU, **settings):
    known = {
        "fixes": {"kind": "pose", "keyframe": True},
        "wheels": {"kind": "odometry", "sigma_translation_floor": 2e-3, "sigma_rotation_floor": 2e-3},
    }
    head = {"space": "3d", "base_frame": "base", "keyframes": {"distance": 100, "angle": 6}, "robust": []}
    sources = {name: known[name] for name in others}
    return config_from({**head, **settings, "sources": [*others, "imu"], **sources, "imu": imu})


def run(settings, *messages):
    """The back-end after all of them, and what was decided."""
    backend, decisions = Backend(settings), []
    everything = sorted((m for each in messages for m in each), key=lambda m: m.stamp)
    for item in settled_stream(everything, settings):
        told = [item] if isinstance(item, Decision) else [d for u in backend.add(item) for d in u.decisions]
        decisions += told
    decisions += [d for update in backend.finish() for d in update.decisions]
    backend.polish()
    return backend, decisions


def rules(decisions):
    return {f"{each.stage}/{each.reason}" for each in decisions}


def last(backend):
    """Newest keyframe, and the estimate of its pose, velocity and bias."""
    keyframe, estimate = backend.timeline.newest, backend.estimate
    return (
        keyframe, estimate.pose(keyframe.pose), estimate.value(velocity_key(keyframe)),
        estimate.value(bias_key(keyframe)),
    )  # fmt: skip


def nees(seed: int) -> float:
    """Squared Mahalanobis distance of pose, velocity and bias at the last of the fixes: 15 degrees of freedom."""
    flight = Flight(seed)
    backend, _ = run(config("fixes"), flight.samples, flight.fixes())
    keyframe, pose, velocity, bias = last(backend)
    n = flight.stamps.index(keyframe.stamp)
    error = np.concatenate([
        gtsam.Pose3.Logmap(pose.between(gtsam.Pose3(flight.poses[n]))),
        flight.velocities[n * RATE // 2] - velocity,
        flight.bias[n * RATE // 2 - 1] - bias.vector(),
    ])  # fmt: skip
    keys = [keyframe.pose, velocity_key(keyframe), bias_key(keyframe)]
    return float(error @ np.linalg.solve(backend.estimate.covariance(keys), error))


def consistent(runs: int) -> None:
    mean = np.mean([nees(seed) for seed in range(runs)])
    low, high = (chi2_quantile(p, 15 * runs) / runs for p in (0.0005, 0.9995))
    assert low < mean < high


def test_alone_with_rare_fixes_it_is_as_wrong_as_it_says():
    """Pose, velocity and bias together."""
    consistent(6)


@pytest.mark.slow
def test_alone_with_rare_fixes_it_is_as_wrong_as_it_says_in_200_flights():
    consistent(200)


def test_nothing_but_an_imu_that_starts_at_rest_goes_where_the_robot_goes():
    """Two seconds of rest, then a flight: without noise, gravity and the bias of the gyroscope are all it needs."""
    flight = Flight(0, QUIET)
    turn, begin = np.array([0.01, -0.02, 0.005]), flight.stamps[0]
    speed = flight.velocities[0]
    push = [  # from rest to the speed of the flight in one second
        ImuSample(begin - SECOND + k * SECOND // RATE, "imu", "base", frozen(turn), frozen(np.array([0, 0, 9.81]) + (speed if k > 0 else 0)), UNSTATED, UNSTATED)
        for k in range(RATE + 1)
    ]  # fmt: skip
    rest = [replace(push[0], stamp=push[0].stamp - k * SECOND // RATE) for k in range(2 * RATE, 0, -1)]
    moving = [replace(each, rate=frozen(each.rate + turn)) for each in flight.samples]
    backend, decisions = run(config(imu={**IMU, "start": "auto"}), rest, push, moving)
    assert "imu/at_rest" in rules(decisions)
    start, end = (backend.snapshot().at([stamp])[0] for stamp in (begin, flight.stamps[-1]))
    moved = gtsam.Pose3(matrix_of(start)).between(gtsam.Pose3(matrix_of(end)))
    wanted = gtsam.Pose3(flight.poses[-1])
    assert moved.range(wanted) < 0.05
    assert np.linalg.norm(gtsam.Rot3.Logmap(moved.rotation().between(wanted.rotation()))) < 0.01


def test_an_imu_elsewhere_on_the_robot_tells_how_the_base_moves():
    """Turned and on an arm: its mounting takes both into account, centripetal acceleration included."""
    mount = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.5, -1.2, 2.0), np.array([0.8, -0.3, 0.5]))
    flight, inertial = Flight(0, QUIET, mount), Inertial("imu", ImuSource())
    begin, pose = flight.stamps[0], gtsam.Pose3(flight.poses[0])
    inertial.add(replace(flight.samples[0], stamp=begin), mount)
    inertial.begin(State(begin, pose, flight.velocities[0], gtsam.imuBias.ConstantBias()), begin)
    for sample in flight.samples:
        inertial.add(sample, mount)
    end = inertial.cut(flight.stamps[-1]).end
    np.testing.assert_allclose(end.pose.translation(), flight.poses[-1][:3, 3], atol=0.05)
    np.testing.assert_allclose(end.velocity, flight.velocities[-1], atol=0.01)


def test_with_fixes_alone_the_yaw_on_the_earth_and_the_speed_are_found():
    """Nothing tells how fast the robot is when it begins, nor where it looks: an IMU, and a fix each second."""
    flight = Flight(4)
    turn, origin = gtsam.Rot3.Yaw(2.0), (49.0, 8.0, 100.0)
    fixes = [
        Fix(each.stamp, "gps", "base", frozen(geodetic(turn.rotate(each.pose[:3]), origin)), frozen(np.eye(3) * 0.01))
        for each in flight.fixes()
    ]  # fmt: skip
    gps = {"kind": "gnss", "keyframe": True}
    settings = config_from({
        "space": "3d", "base_frame": "base", "keyframes": {"distance": 100, "angle": 6}, "earth": {"origin": origin},
        "sources": ["imu", "gps"], "imu": IMU, "gps": gps,
    })  # fmt: skip
    backend, _ = run(settings, flight.samples, fixes)
    keyframe, pose, velocity, _ = last(backend)
    map_T_earth = backend.estimate.pose(EARTH)
    n = flight.stamps.index(keyframe.stamp)
    found = map_T_earth.transformTo(pose.translation())
    assert np.linalg.norm(found - turn.rotate(flight.poses[n][:3, 3])) < 0.4
    speed = map_T_earth.rotation().unrotate(velocity)
    assert np.linalg.norm(speed - turn.rotate(flight.velocities[n * RATE // 2])) < 0.2


def test_odometry_drives_and_the_imu_finds_its_bias_and_the_tilt():
    """The odometry starts level, the robot does not: gravity says so."""
    flight = Flight(3)
    backend, decisions = run(config("wheels", keyframes={"every": True}), flight.samples, flight.odometry())
    keyframe, _, velocity, bias = last(backend)
    assert "imu/in_motion" in rules(decisions)
    kinds = [factor.kind for factor in backend.solver.factors.values()]
    assert kinds.count("motion") == kinds.count("imu") - 2 + 1 == 2 * SECONDS
    sigma = np.sqrt(np.diag(backend.estimate.covariance([bias_key(keyframe)])))
    assert (np.abs(bias.vector() - flight.bias[-1]) < 4 * sigma).all()
    assert (sigma[3:5] < FLIGHT.gyroscope_bias / 2).all()  # about the axes that gravity tells
    assert abs(np.linalg.norm(velocity) - 1) < 0.1


def test_a_gap_and_a_saturated_sample_cost_their_stretch_and_nothing_else():
    flight = Flight(1)
    hit = 9 * RATE
    violent = replace(flight.samples[hit], acceleration=frozen((200.0, 0.0, 9.8)))
    samples = [
        *flight.samples[: 5 * RATE],
        *flight.samples[6 * RATE : hit],
        violent,
        *flight.samples[hit + 1 :],
    ]
    settings = config("fixes", imu={**IMU, "max_acceleration": 157.0})
    backend, decisions = run(settings, samples, flight.fixes())
    assert {"imu/gap", "imu/saturated"} <= rules(decisions)
    refused = [each for each in decisions if each.stage == "imu" and each.verdict == "refused"]
    assert len(refused) <= 4
    end = backend.snapshot().at([flight.stamps[-1]])[0]
    assert np.linalg.norm(end[:3] - flight.poses[-1][:3, 3]) < 0.5


def test_samples_that_somebody_drew_across_a_gap_count_as_a_gap():
    flight = Flight(1)
    first, last = 5 * RATE, 7 * RATE
    ends = flight.samples[first], flight.samples[last]
    drawn = [
        replace(each, **{
            name: frozen(getattr(ends[0], name) + (getattr(ends[1], name) - getattr(ends[0], name)) * k / (last - first))
            for name in ("rate", "acceleration")
        })
        for k, each in enumerate(flight.samples[first:last])
    ]  # fmt: skip
    samples = [*flight.samples[:first], *drawn, *flight.samples[last:]]
    _, decisions = run(config("fixes"), samples, flight.fixes())
    found = [each for each in decisions if each.reason == "interpolated"]
    assert 2 <= len(found) <= 3
    assert all(flight.stamps[0] + 5 * SECOND < each.stamp < flight.stamps[0] + 8 * SECOND for each in found)


def test_an_imu_that_repeats_its_last_sample_is_said_once():
    """For three seconds in the midst of the flight; the samples are used, since a simulator may have no noise."""
    flight = Flight(1)
    first, last = 5 * RATE, 8 * RATE
    stuck = [replace(flight.samples[first], stamp=each.stamp) for each in flight.samples[first : last + 1]]
    samples = [*flight.samples[:first], *stuck, *flight.samples[last + 1 :]]
    _, decisions = run(config("wheels"), samples, flight.odometry())
    (told,) = [each for each in decisions if each.reason == "stuck"]
    assert told.verdict == "accepted"
    assert 1.0 < told.statistic < 1.1
    assert "stuck" not in {
        each.reason for each in run(config("wheels"), flight.samples, flight.odometry())[1]
    }


def test_while_the_imu_is_silent_odometry_goes_on_and_afterwards_it_begins_anew():
    flight = Flight(2)
    samples = [*flight.samples[: 4 * RATE], *flight.samples[8 * RATE :]]
    backend, decisions = run(config("wheels", keyframes={"every": True}), samples, flight.odometry())
    assert len(backend.timeline) == len(flight.stamps)
    assert [each.reason for each in decisions if each.stage == "imu"] == ["in_motion", "gap", "in_motion"]
    silent = backend.timeline.keyframes[12]
    assert not backend.estimate.knows(velocity_key(silent))
    assert backend.estimate.knows(velocity_key(backend.timeline.newest))


@pytest.mark.parametrize("scale", [1 / 9.81, 0.0])
def test_accelerations_in_g_or_without_gravity_are_refused(scale):
    flight = Flight(0)
    samples = [replace(each, acceleration=frozen(each.acceleration * scale)) for each in flight.samples]
    backend, decisions = run(config("wheels", keyframes={"every": True}), samples, flight.odometry())
    assert "imu/gravity" in rules(decisions)
    assert not [each for each in backend.solver.factors.values() if each.kind == "imu"]


def test_rates_in_degrees_per_second_are_refused_as_soon_as_the_robot_turns():
    flight = Flight(0)
    samples = [replace(each, rate=frozen(np.degrees(each.rate))) for each in flight.samples]
    backend, decisions = run(config("wheels", keyframes={"every": True}), samples, flight.odometry())
    told = [each for each in decisions if each.reason == "degrees"]
    assert {each.verdict for each in told} == {"refused"}
    factors = [each.factor for each in backend.solver.factors.values()]
    assert not [each for each in factors if isinstance(each, gtsam.CombinedImuFactor)]
    assert (
        len(told) == len(backend.timeline) - 2
    )  # of a spiral each step is a turn; the IMU begins with the second keyframe
    right, decisions = run(config("wheels", keyframes={"every": True}), flight.samples, flight.odometry())
    assert "imu/degrees" not in rules(decisions)
    ends = [each.snapshot().at(np.array(flight.stamps[-1:]))[0, :3] for each in (backend, right)]
    assert np.abs(ends[0] - ends[1]).max() < 0.5


def test_an_imu_on_its_side_is_noticed():
    flight = Flight(0)
    samples = [
        replace(each, acceleration=frozen(np.roll(each.acceleration, 2)), rate=frozen(np.roll(each.rate, 2)))
        for each in flight.samples
    ]
    _, decisions = run(config(), samples)
    assert "imu/sideways" in rules(decisions)


def test_samples_from_a_frame_that_nobody_knows_are_refused():
    flight = Flight(0)
    samples = [replace(each, frame="imu_link") for each in flight.samples]
    _, decisions = run(config("wheels"), samples, flight.odometry())
    assert "imu/unknown_frame" in rules(decisions)


def test_a_fix_that_comes_late_cuts_the_stretch_as_if_it_had_come_in_time():
    """It asks for a keyframe in the past, which samples have gone beyond."""
    flight = Flight(5)
    fixes, settings = flight.fixes(), config("fixes", imu={**IMU, "keyframe_time": 5})
    in_time, _ = run(settings, flight.samples, fixes)
    late = Backend(settings)
    for sample in flight.samples:
        for fix in fixes:
            if 0 <= sample.stamp - fix.stamp - SECOND // 5 < SECOND // RATE:
                late.add(fix)
        late.add(sample)
    late.finish()
    late.polish()
    stamps = in_time.snapshot().stamps[:-1]  # the last fix is too late
    np.testing.assert_array_equal(late.snapshot().stamps[:-1], stamps)
    for stamp in stamps.tolist():
        found = [each.solver.factors.get(f"imu/{format_stamp(stamp)}/0") for each in (late, in_time)]
        if all(found):
            np.testing.assert_allclose(*(each.motion.covariance for each in found), rtol=1e-3)


def test_the_noise_is_that_of_the_messages_where_these_are_to_tell():
    """At each keyframe, be it at a sample or between two: the variance of one sample times the time between them."""
    flight = Flight(0)
    stated = frozen(np.eye(3).ravel() * 4.0)
    inertial = Inertial("imu", ImuSource(noise="message", accelerometer_density=0.3))
    state = State(flight.stamps[0], gtsam.Pose3(), np.zeros(3), gtsam.imuBias.ConstantBias())
    samples = [
        replace(each, rate_covariance=stated, acceleration_covariance=stated) for each in flight.samples
    ]
    inertial.add(replace(samples[0], stamp=flight.stamps[0]), None)
    for n, begin in ((1, samples[4].stamp), (5, samples[9].stamp + 1000), (10, samples[20].stamp)):
        for sample in samples[n : n + 11]:
            if sample.stamp <= begin:
                inertial.add(sample, None)
        inertial.begin(replace(state, stamp=begin), begin)
        params = inertial._params  # what the factors are made with
        np.testing.assert_allclose(np.diag(params.getGyroscopeCovariance()), 4.0 / RATE, rtol=1e-6)
        np.testing.assert_allclose(np.diag(params.getAccelerometerCovariance()), 0.09)


def test_a_plane_and_a_second_imu_are_refused():
    imu = {"kind": "imu"}
    with pytest.raises(BadConfig, match="needs space: 3d"):
        config_from({"space": "2d", "sources": ["imu"], "imu": imu})
    with pytest.raises(BadConfig, match="a second IMU"):
        config_from({"space": "3d", "sources": ["imu", "other"], "imu": imu, "other": imu})
