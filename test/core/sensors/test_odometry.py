"""Odometry: what the messages say, and the one motion factor between two keyframes."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from slam_backend.core.config import OdometrySource
from slam_backend.core.graph import Motion
from slam_backend.core.measurement import SECOND, Measurement
from slam_backend.core.sensors.odometry import (
    DECODERS,
    decode_odometry,
    decode_pose,
    decode_pose_with_covariance,
    decode_transforms,
    factors,
)


def messages() -> dict[str, SimpleNamespace]:
    xyz = SimpleNamespace(x=1.0, y=2.0, z=3.0)
    pose = SimpleNamespace(position=xyz, orientation=SimpleNamespace(x=0.1, y=0.2, z=0.6, w=0.8))
    header = SimpleNamespace(stamp=SimpleNamespace(sec=4, nanosec=5), frame_id="odom")
    with_covariance = SimpleNamespace(pose=pose, covariance=np.arange(36.0))
    twist = SimpleNamespace(linear=xyz, angular=SimpleNamespace(x=4.0, y=5.0, z=6.0))
    return {
        "Odometry": SimpleNamespace(
            header=header, child_frame_id="base_link", pose=with_covariance,
            twist=SimpleNamespace(twist=twist, covariance=2 * np.arange(36.0)),
        ),
        "PoseWithCovarianceStamped": SimpleNamespace(header=header, pose=with_covariance),
        "PoseStamped": SimpleNamespace(header=header, pose=pose),
    }  # fmt: skip


def test_an_odometry_is_read_whole():
    told = decode_odometry(messages()["Odometry"], "wheels")
    assert (told.stamp, told.source, told.frame, told.child) == (
        4 * SECOND + 5,
        "wheels",
        "odom",
        "base_link",
    )
    np.testing.assert_array_equal(told.pose, [1, 2, 3, 0.1, 0.2, 0.6, 0.8])
    np.testing.assert_array_equal(told.covariance, np.arange(36))
    np.testing.assert_array_equal(told.twist, [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(told.twist_covariance, 2 * np.arange(36))


@pytest.mark.parametrize("decode", [decode_pose_with_covariance, decode_pose])
def test_what_a_plain_pose_does_not_say_is_unknown(decode):
    name = "PoseStamped" if decode is decode_pose else "PoseWithCovarianceStamped"
    told = decode(messages()[name], "wheels")
    assert (told.stamp, told.frame, told.child) == (4 * SECOND + 5, "odom", "")
    np.testing.assert_array_equal(told.pose, [1, 2, 3, 0.1, 0.2, 0.6, 0.8])
    assert told.covariance.any() == (decode is decode_pose_with_covariance)
    assert not told.twist.any()
    assert not told.twist_covariance.any()


def transform(parent, child, seconds):
    stamp = SimpleNamespace(sec=seconds, nanosec=0)
    turn = SimpleNamespace(x=0.0, y=0.0, z=0.6, w=0.8)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id=parent), child_frame_id=child,
        transform=SimpleNamespace(translation=SimpleNamespace(x=1.0, y=2.0, z=3.0), rotation=turn),
    )  # fmt: skip


def test_of_transforms_the_pair_odom_to_base_is_the_odometry():
    """In whatever namespace; a frame that only sounds like it is another."""
    pairs = [
        ("map", "odom"),
        ("odom", "base_link"),
        ("base_link", "odom"),
        ("/r1/odom", "r1/base"),
        ("wheel_odom", "b"),
    ]
    message = SimpleNamespace(transforms=[transform(*pair, n) for n, pair in enumerate(pairs)])
    told = list(decode_transforms(message, "tf"))
    assert [(t.stamp, t.source, t.frame, t.child) for t in told] == [
        (1 * SECOND, "tf", "odom", "base_link"),
        (3 * SECOND, "tf", "/r1/odom", "r1/base"),
    ]
    np.testing.assert_array_equal(told[0].pose, [1, 2, 3, 0, 0, 0.6, 0.8])
    assert not told[0].covariance.any()


@pytest.mark.parametrize("name", messages())
def test_records_never_change(name):
    told = DECODERS[f"{'nav' if name == 'Odometry' else 'geometry'}_msgs/msg/{name}"](
        messages()[name], "wheels"
    )
    for array in (told.pose, told.covariance, told.twist, told.twist_covariance):
        assert not array.flags.writeable
    with pytest.raises(AttributeError):
        told.stamp = 3


def test_a_keyframe_is_joined_to_the_last_by_one_factor_however_long_the_window(world, offered):
    a, b = world.timeline.keyframes[:2]
    window = offered(*(Measurement(stamp, "wheels") for stamp in range(a.stamp, b.stamp, SECOND // 4)))
    delta = factors(window, a, b, world.context(), OdometrySource())
    (made,) = delta.add
    assert (made.id, made.kind, made.keys) == ("wheels/6.000000000/0", "motion", (a.pose, b.pose))
    assert made.factor.error(world.values()) < 1e-12
    assert delta.values[b.pose].equals(world.track.pose(b.stamp), 1e-9)


def test_the_noise_of_the_factor_is_that_of_the_motion(world, offered, agree):
    """Whitened by its own noise, the error of a wrong odometry is standard normal."""
    rng, space = np.random.default_rng(1), world.space
    a, b = world.timeline.keyframes[:2]
    stated, errors = world.track.motion(a.stamp, b.stamp), []
    for error in rng.multivariate_normal(np.zeros(space.dimension), stated.covariance, size=3_000):
        wrong = Motion(stated.pose.compose(space.expmap(error)), stated.covariance)
        context = replace(world.context(), motion=lambda *_, wrong=wrong: wrong)
        (made,) = factors(offered(Measurement(b.stamp, "wheels")), a, b, context, OdometrySource()).add
        errors.append(made.factor.whitenedError(world.values()))
    agree(errors)


def test_the_first_keyframe_and_an_empty_window_make_nothing(world, offered):
    a, b = world.timeline.keyframes[:2]
    assert not factors(offered(Measurement(1, "wheels")), None, b, world.context(), OdometrySource())
    assert not factors([], a, b, world.context(), OdometrySource())
