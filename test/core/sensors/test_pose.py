"""Absolute poses: priors on the nearest keyframe that fit the truth with the noise they state."""

from dataclasses import replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from slam_backend.core.config import PoseSource
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.pose import AbsolutePose, decode, factors

STAMPS = pytest.mark.parametrize("stamp", [6 * SECOND, 7 * SECOND, 5 * SECOND], ids=["at", "after", "before"])
FRAMES = pytest.mark.parametrize("frame", ["", "mast"], ids=["base", "mast"])
ROS_SIGMAS = np.array([0.03, 0.01, 0.02, 0.004, 0.012, 0.008])


def ros_error(space, pose, error):
    """A pose with an error as ROS means it: about and along the fixed axes of the parent."""
    if space.name == "2d":
        return gtsam.Pose2(pose.x() + error[0], pose.y() + error[1], pose.theta() + error[5])
    return gtsam.Pose3(gtsam.Rot3.Expmap(error[3:]) * pose.rotation(), pose.translation() + error[:3])


def localized(world, stamp, frame, covariance, rng=None) -> AbsolutePose:
    base = world.track.pose(stamp) if rng is None else world.wrongly(rng, stamp)
    pose = base.compose(world.mounts.get(frame))
    if rng is not None:
        pose = ros_error(world.space, pose, rng.multivariate_normal(np.zeros(6), covariance))
    return AbsolutePose(stamp, "amcl", frame, frozen(world.space.seven(pose)), frozen(np.ravel(covariance)))


@STAMPS
@FRAMES
def test_a_true_pose_has_no_error_at_the_truth(world, offered, stamp, frame):
    seen = localized(world, stamp, frame, np.diag(ROS_SIGMAS**2))
    (made,) = factors(offered(seen), None, None, world.context(), PoseSource()).add
    assert (made.kind, made.keys, made.stamp) == ("pose", (world.place(stamp).keyframe.pose,), stamp)
    assert made.factor.error(world.values()) < 1e-12


@STAMPS
@FRAMES
def test_the_noise_is_that_of_the_pose_and_of_the_motion(world, offered, agree, spread, stamp, frame):
    """Whitened by their own noise, errors at the truth are standard normal."""
    rng = np.random.default_rng(1)
    covariance = spread(rng, ROS_SIGMAS)
    context, values, errors = world.context(), world.values(), []
    for _ in range(1_500):
        seen = localized(world, stamp, frame, covariance, rng)
        (made,) = factors(offered(seen), None, None, context, PoseSource()).add
        errors.append(made.factor.whitenedError(values))
    agree(errors)


def test_at_a_keyframe_it_is_the_native_prior(world, offered):
    seen = localized(world, 6 * SECOND, "", np.diag(ROS_SIGMAS**2), np.random.default_rng(2))
    (made,) = factors(offered(seen), None, None, world.context(), PoseSource()).add
    pose = world.space.pose(seen.pose.tolist())
    noise = gtsam.noiseModel.Gaussian.Covariance(world.space.covariance(seen.covariance, pose))
    native = world.space.prior(made.keys[0], pose, noise)
    assert made.factor.equals(native, 1e-9)
    assert made.factor.error(world.values()) == pytest.approx(native.error(world.values()), rel=1e-9)


@pytest.mark.parametrize("yaw", [0.0, 0.8, np.pi / 2])
def test_a_zero_variance_takes_its_default_on_its_own_axis_whatever_the_pose(world, offered, yaw):
    pose = frozen(world.space.seven(world.space.from_extrinsics((1, 0, 0, 0, 0, yaw))))

    def noise(*variances):
        seen = AbsolutePose(6 * SECOND, "amcl", "", pose, frozen(np.diag(variances).ravel()))
        config = PoseSource(sigma_translation=0.3, sigma_rotation=0.2)
        (made,) = factors(offered(seen), None, None, world.context(), config).add
        root = made.factor.noiseModel().R()
        return np.linalg.inv(root.T @ root)

    got = noise(0.0, 0.01, 0.01, 0.01, 0.01, 0.0)
    np.testing.assert_allclose(got, noise(0.09, 0.01, 0.01, 0.01, 0.01, 0.04), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(noise(*[0.0] * 6), world.space.diagonal(0.04, 0.09), rtol=1e-9, atol=1e-12)


def test_what_cannot_be_used_becomes_a_decision(world, offered):
    good = localized(world, 6 * SECOND, "", np.diag(ROS_SIGMAS**2))
    bad = [replace(good, stamp=90 * SECOND), replace(good, frame="tail")]
    delta = factors(offered(*bad), None, None, world.context(), PoseSource())
    assert [(d.stage, d.reason) for d in delta.decisions] == [
        ("pose", "uncovered"),
        ("pose", "unknown_frame"),
    ]


def test_the_message_is_read_as_a_pose_of_the_base():
    pose = SimpleNamespace(
        position=SimpleNamespace(x=1.0, y=2.0, z=3.0), orientation=SimpleNamespace(x=0.0, y=0.0, z=0.6, w=0.8)
    )
    header = SimpleNamespace(stamp=SimpleNamespace(sec=4, nanosec=5), frame_id="map")
    told = decode(
        SimpleNamespace(header=header, pose=SimpleNamespace(pose=pose, covariance=range(36))), "amcl"
    )
    assert (told.stamp, told.source, told.frame) == (4 * SECOND + 5, "amcl", "")
    np.testing.assert_array_equal(told.pose, [1, 2, 3, 0, 0, 0.6, 0.8])
    np.testing.assert_array_equal(told.covariance, np.arange(36))
