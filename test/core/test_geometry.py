"""Arrays of poses agree with gtsam's, and ROS's covariance means what ROS says."""

import gtsam
import numpy as np
import pytest

from slam_backend.core.geometry import (
    covariance_from_ros,
    covariance_to_ros,
    inverse_of,
    matrix_of,
    quaternion_of,
    rotation_of,
    seven_of_matrix,
)


def poses(rng, count) -> list[gtsam.Pose3]:
    return [gtsam.Pose3.Expmap(v) for v in rng.normal(size=(count, 6)) * 2]


def half_turns() -> np.ndarray:
    """Rotations by pi, where three of Shepperd's four candidates vanish, and the identity."""
    return np.stack([np.eye(3), *(2 * np.outer(e, e) - np.eye(3) for e in np.eye(3))])


def test_rotations_and_quaternions_agree_with_gtsam():
    for pose in poses(np.random.default_rng(1), 50):
        rotation, q = pose.rotation().matrix(), pose.rotation().toQuaternion()
        ours = quaternion_of(rotation)
        sign = 1 if q.w() >= 0 else -1
        np.testing.assert_allclose(ours, sign * np.array([q.x(), q.y(), q.z(), q.w()]), atol=1e-12)
        np.testing.assert_allclose(rotation_of(ours), rotation, atol=1e-12)


def test_quaternions_of_half_turns_are_exact_and_never_have_a_negative_w():
    q = quaternion_of(half_turns())
    np.testing.assert_allclose(rotation_of(q), half_turns(), atol=1e-15)
    assert (q[:, 3] >= 0).all()


def test_a_quaternion_of_any_length_is_normalized():
    q = np.array([0.1, -0.2, 0.3, 0.9])
    np.testing.assert_allclose(rotation_of(7 * q), rotation_of(q), atol=1e-15)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_every_function_takes_any_number_of_poses(shape):
    rng = np.random.default_rng(2)
    sevens = rng.normal(size=(*shape, 7))
    matrices = matrix_of(sevens)
    assert matrices.shape == (*shape, 4, 4)
    np.testing.assert_allclose(matrix_of(seven_of_matrix(matrices)), matrices, atol=1e-12)
    np.testing.assert_allclose(
        inverse_of(matrices) @ matrices, np.broadcast_to(np.eye(4), matrices.shape), atol=1e-12
    )
    covariance = np.broadcast_to(np.diag(np.arange(1.0, 7.0)), (*shape, 6, 6))
    assert covariance_from_ros(covariance, matrices[..., :3, :3]).shape == (*shape, 6, 6)


def test_ros_covariance_becomes_that_of_gtsams_tangent(agree, spread):
    """ROS: the translation moves along the parent's axes, the rotation turns about the parent's fixed axes."""
    rng = np.random.default_rng(3)
    truth = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.4, -0.7, 2.0), np.array([3.0, -2.0, 1.0]))
    ros = spread(rng, [0.02, 0.01, 0.04, 0.004, 0.012, 0.008])
    errors = rng.multivariate_normal(np.zeros(6), ros, size=20_000)
    tangents = [
        gtsam.Pose3.Logmap(
            truth.between(
                gtsam.Pose3(gtsam.Rot3.Expmap(e[3:]) * truth.rotation(), truth.translation() + e[:3])
            )
        )
        for e in errors
    ]
    agree(tangents, covariance_from_ros(ros, truth.rotation().matrix()))


def test_covariance_to_ros_is_the_inverse(spread):
    rng = np.random.default_rng(4)
    ros = spread(rng, np.arange(1.0, 7.0))
    rotation = poses(rng, 1)[0].rotation().matrix()
    np.testing.assert_allclose(
        covariance_to_ros(covariance_from_ros(ros, rotation), rotation), ros, atol=1e-12
    )
    np.testing.assert_allclose(
        covariance_from_ros(covariance_to_ros(ros, rotation), rotation), ros, atol=1e-12
    )
