"""~/odometry between two answers of the solver: where the robot is, and how certain that is."""

import numpy as np
import pytest

from slam_backend.core.backend import Update
from slam_backend.core.config import Config, config_from
from slam_backend.core.graph import keyframe
from slam_backend.core.measurement import SECOND
from slam_backend.core.sensors.odometry import OdometryPose
from slam_backend.ros.pose import UNKNOWN, Odometer, composed

START = 1_700_000_000 * SECOND
QUIET = config_from({
    "space": "2d", "sources": ["wheels"],
    "wheels": {
        "kind": "odometry", "topic": "/odom", "sigma_translation_per_meter": 0.0, "sigma_rotation_per_meter": 0.0,
        "sigma_translation_per_radian": 0.0, "sigma_rotation_per_radian": 0.0,
    },
})  # fmt: skip


def seven(x=0.0, y=0.0, yaw=0.0):
    return (x, y, 0.0, 0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))


def odometry(n, *pose):
    return OdometryPose(
        START + n * SECOND,
        "wheels",
        "odom",
        "base",
        np.array(seven(*pose)),
        np.zeros(36),
        np.zeros(6),
        np.zeros(36),
    )


def update(pose, correction):
    return Update(keyframe(3, START), pose, correction, 1, ())


def spread(x=0.0, y=0.0, yaw=0.0):
    """A diagonal covariance, 36 in ROS order."""
    return np.diag([x, y, 0.0, 0.0, 0.0, yaw]).ravel()


def axes(located):
    """Variances of x, y and yaw."""
    return np.diag(located.covariance.reshape(6, 6))[[0, 1, 5]]


def test_before_the_first_answer_there_is_no_pose() -> None:
    assert Odometer(QUIET).locate(odometry(0), None, None) is None


def test_the_pose_is_the_correction_and_then_the_odometry() -> None:
    """A quarter turn between map and odom: what odometry calls ahead is to the left in the map."""
    correction = seven(1.0, 2.0, np.pi / 2)
    located = Odometer(QUIET).locate(odometry(1, 3.0), update(correction, correction), spread(1, 1, 1))
    assert located.seven == pytest.approx(seven(1.0, 5.0, np.pi / 2))
    assert located.correction == correction
    assert composed(located.correction, seven(3.0)) == located.seven


def test_at_the_keyframe_the_covariance_is_that_of_the_keyframe() -> None:
    """In the axes of the map, whichever way the robot looks."""
    here = seven(yaw=0.7)
    located = Odometer(Config(space="2d")).locate(
        odometry(0, 0.0, 0.0, 0.7), update(here, seven()), spread(0.04, 0.01, 0.001)
    )
    assert axes(located) == pytest.approx([0.04, 0.01, 0.001])


def test_ahead_of_a_keyframe_of_uncertain_heading_the_robot_may_be_left_or_right() -> None:
    """Ten metres times the angle; along its way nothing is added when odometry is perfect."""
    located = Odometer(QUIET).locate(odometry(1, 10.0), update(seven(), seven()), spread(0.01, 0.01, 0.02**2))
    assert axes(located) == pytest.approx([0.01, 0.01 + (10 * 0.02) ** 2, 0.02**2])
    covariance = located.covariance.reshape(6, 6)
    assert covariance[1, 5] == covariance[5, 1] == pytest.approx(10 * 0.02**2)


def test_it_grows_with_the_way_until_the_next_answer() -> None:
    odometer, known = Odometer(Config(space="2d")), update(seven(), seven())
    grown = [axes(odometer.locate(odometry(n, float(n)), known, spread(0.01, 0.01, 1e-4))) for n in range(5)]
    assert (np.diff(grown, axis=0) > 0).all()


def test_what_is_not_determined_does_not_look_certain() -> None:
    located = Odometer(QUIET).locate(odometry(1, 1.0), update(seven(), seven()), None)
    assert located.covariance is UNKNOWN
    assert axes(located).min() >= 1e6


def test_only_a_newer_stamp_goes_on() -> None:
    odometer = Odometer(QUIET)
    assert [odometer.goes_on(stamp) for stamp in (5, 6, 6, 3, 7)] == [True, True, False, False, True]


def test_where_the_odometry_jumps_nothing_is_told_until_the_worker_knows_what_it_was() -> None:
    """A restart: from then on in the new frame. A lone jump: the next message goes on from before."""
    odometer, correction = Odometer(QUIET), seven(0.0, 7.0)

    def x_of(n, x, told):
        located = odometer.locate(odometry(n, x), told, spread(1, 1, 1))
        return None if located is None else pytest.approx(located.seven[0])

    before = update(seven(), correction)
    assert [x_of(1, 1.0, before), x_of(2, 500.0, before), x_of(3, 501.0, before)] == [1.0, None, None]
    after = Update(keyframe(4, START + 2 * SECOND), seven(2.0, 7.0), correction, 1, (), seven(-498.0))
    assert [x_of(4, 502.0, after), x_of(5, 900.0, after), x_of(6, 504.0, after)] == [4.0, None, 6.0]
    located = odometer.locate(odometry(7, 505.0), after, None)
    assert located is not None
    assert composed(located.correction, seven(505.0)) == pytest.approx(seven(7.0, 7.0))
