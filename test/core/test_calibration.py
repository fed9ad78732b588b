"""Constants of sensors that are estimated with the map: found where the data tell them, left alone where they do not."""

from dataclasses import replace

import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.errors import BadConfig
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.landmark import LandmarkObservation
from slam_backend.core.sensors.odometry import OdometryPose
from slam_backend.lab.options import Options
from slam_backend.lab.simulate import Simulation, simulate

POSES = 160


def drive(seed=0, scenario="city", **options) -> Simulation:
    usual = {"poses": POSES, "landmarks": 20, "landmark_range": 30.0, "loop_rate": 0.0}
    return simulate(scenario, seed, Options(**{**usual, **options}))


def run(simulation, items=None, **calibrate) -> Backend:
    """calibrate: by source, what is to be calibrated."""
    settings = {
        name: dict(value) if isinstance(value, dict) else value for name, value in simulation.settings.items()
    }
    for source, names in calibrate.items():
        settings[source]["calibrate"] = list(names)
    backend = Backend(config_from({**settings, "robust": []}))
    for item in items or sorted(
        simulation.measurements, key=lambda m: (m.stamp, isinstance(m, OdometryPose))
    ):
        backend.add(item)
    backend.finish()
    return backend


def in_order(measurements) -> list:
    """As settled: of equal stamps, the odometry last."""
    return sorted(measurements, key=lambda m: (m.stamp, isinstance(m, OdometryPose)))


def off(found, truth) -> float:
    """In standard deviations."""
    assert found.sigma is not None
    return (found.value - truth) / found.sigma


@pytest.fixture(scope="module")
def long() -> Simulation:
    """Ranges that are 7 % too long, and no other sight of the landmarks."""
    return drive(landmark_form="range", range_scale=1.07)


@pytest.fixture(scope="module")
def found_out(long) -> Backend:
    return run(long, landmarks=["range_scale"])


@pytest.fixture(scope="module")
def believed(long) -> Backend:
    return run(long)


def test_ranges_that_are_too_long_are_found_out_together_with_the_map(found_out):
    found = found_out.calibration.found["landmarks"]["range_scale"]
    assert found.sigma < 0.02
    assert abs(off(found, 1.07)) < 3.5


def test_it_is_off_by_default_and_then_nothing_is_told(believed):
    assert not believed.calibration
    assert believed.calibration.found == {}


def test_the_map_is_better_for_it(long, found_out, believed):
    def error(backend) -> float:
        snapshot = backend.snapshot()
        true = np.array([long.landmarks[int(name)][:2] for name in snapshot.names])
        return float(np.median(np.linalg.norm(snapshot.landmarks[:, :2] - true, axis=1)))

    assert error(found_out) < 0.6 * error(believed)


def faulty(simulation, twisted):
    """The drive with odometry that tells of every step another twist (x, y, yaw) than it was."""
    from slam_backend.core.space import SPACES

    space = SPACES["2d"]
    pose, last = space.identity, None
    for item in in_order(simulation.measurements):
        if isinstance(item, OdometryPose):
            here = space.pose(item.pose.tolist())
            if last is not None:
                pose = pose.compose(space.expmap(twisted(space.logmap(last.between(here)))))
            last = here
            yield replace(item, pose=frozen(space.seven(pose)))
        else:
            yield item


def test_odometry_that_tells_too_much_is_found_out_by_landmarks():
    simulation = drive(sigma_rotation_per_meter=0.001, sigma_rotation_per_radian=0.002)
    items = list(faulty(simulation, lambda twist: twist * (1.04, 1.04, 1.07)))
    found = run(simulation, items, wheels=["distance_scale", "turn_scale"]).calibration.found["wheels"]
    assert abs(off(found["distance_scale"], 1.04)) < 3.5
    assert abs(off(found["turn_scale"], 1.07)) < 3.5
    assert found["distance_scale"].sigma < 0.01


def test_wheels_that_lose_way_in_turns_and_draw_to_one_side_are_found_out_by_landmarks():
    """Bearings and ranges tell both without the size of the map being known otherwise."""
    simulation = drive(sigma_rotation_per_meter=0.001, sigma_rotation_per_radian=0.002)

    def twisted(twist):
        x, y, yaw = twist
        return np.array([x + 0.1 * abs(yaw + 0.02 * x), y, yaw + 0.02 * x])

    names = ["distance_per_radian", "turn_per_meter"]
    found = run(simulation, list(faulty(simulation, twisted)), wheels=names).calibration.found["wheels"]
    assert abs(off(found["distance_per_radian"], 0.1)) < 3.5
    assert abs(off(found["turn_per_meter"], 0.02)) < 3.5
    assert found["distance_per_radian"].sigma < 0.05
    assert found["turn_per_meter"].sigma < 0.005


def test_a_clock_that_is_late_and_a_mounting_that_is_wrong_are_found_out():
    simulation = drive(landmark_range=12.0)

    def wrong(item):
        if not isinstance(item, LandmarkObservation):
            return item
        x, y, z = item.value  # the sensor is turned by 0.05 rad and sits 0.2 m to the left
        c, s = np.cos(0.05), np.sin(0.05)
        value = np.array([c * x + s * (y - 0.2), -s * x + c * (y - 0.2), z])
        return replace(item, stamp=item.stamp + round(0.15 * SECOND), value=frozen(value))

    items = in_order(map(wrong, simulation.measurements))
    found = run(simulation, items, landmarks=["time_offset", "mount"]).calibration.found["landmarks"]
    assert abs(off(found["time_offset"], -0.15)) < 3.5
    assert abs(off(found["rotation.z"], 0.05)) < 3.5
    assert found["time_offset"].sigma < 0.02


def test_what_the_data_cannot_tell_is_refused_and_left_as_it_was(long):
    """Ranges and odometry that are both too long make the same map, larger: neither can be told from the other."""
    backend = run(long, landmarks=["range_scale"], wheels=["distance_scale"])
    found = backend.calibration.found
    assert (found["landmarks"]["range_scale"].value, found["landmarks"]["range_scale"].sigma) == (1.0, None)
    assert (found["wheels"]["distance_scale"].value, found["wheels"]["distance_scale"].sigma) == (1.0, None)


def test_each_estimate_is_a_decision_with_value_and_sigma(long):
    settings = {
        **long.settings,
        "robust": [],
        "landmarks": {**long.settings["landmarks"], "calibrate": ["range_scale"]},
    }
    backend, told = Backend(config_from(settings)), []
    for item in in_order(long.measurements):
        told += [d for update in backend.add(item) for d in update.decisions if d.stage == "calibration"]
    assert {d.verdict for d in told} <= {"accepted", "refused"}
    assert (told[-1].verdict, told[-1].reason, told[-1].source) == ("accepted", "estimated", "landmarks")
    assert told[-1].basis["value"] == pytest.approx(1.07, abs=0.04)
    assert len(told) < 12  # at keyframes that are further and further apart


def test_only_the_odometry_that_drives_can_be_calibrated():
    two = {"a": {"kind": "odometry"}, "b": {"kind": "odometry", "calibrate": ["turn_scale"]}}
    with pytest.raises(BadConfig, match="drives the keyframes"):
        Backend(config_from({"sources": ["a", "b"], **two}))


@pytest.mark.parametrize(
    ("space", "known", "told", "true"),
    [
        ("2d", {"distance_scale": 2.0}, (1, 0), (0.5, 0)),
        ("2d", {"turn_per_meter": 0.1}, (2, 0.5), (2, 0.3)),
        ("3d", {"turn_per_meter": 0.1}, (-2, 0.5), (-2, 0.7)),
        ("2d", {"distance_per_radian": 0.4}, (1, 0.5), (0.8, 0.5)),
        ("3d", {"distance_per_radian": 0.4}, (-1, -0.5), (-0.8, -0.5)),
        ("2d", {"distance_per_radian": 4.0}, (1, 0.5), (0, 0.5)),
        ("2d", {"distance_per_radian": 4.0}, (0, 0.5), (0, 0.5)),
    ],
)
def test_constants_that_are_known_are_said_in_the_configuration(space, known, told, true):
    """Of the driving odometry, without any estimate: (m ahead, rad to the left) along an arc, as told and as it was. What is lost in a
    turn is at most the whole way.
    """
    from slam_backend.core.space import SPACES

    wheels = {"kind": "odometry", **known}
    keyframes = {"every": True}
    backend = Backend(
        config_from({"space": space, "keyframes": keyframes, "sources": ["wheels"], "wheels": wheels})
    )

    def arc(meters, radians):
        return SPACES["2d"].expmap(np.array([meters, 0.0, radians]))

    for second, twist in ((1, (0.0, 0.0)), (2, told)):
        zeros = frozen(np.zeros(36))
        seven = frozen(SPACES["2d"].seven(arc(*twist)))
        backend.add(
            OdometryPose(second * SECOND, "wheels", "odom", "base", seven, zeros, frozen(np.zeros(6)), zeros)
        )
    here = backend.snapshot().poses[1]
    np.testing.assert_allclose(here[:2, 3], arc(*true).translation(), atol=1e-6)
    np.testing.assert_allclose(np.arctan2(here[1, 0], here[0, 0]), true[1], atol=1e-6)
