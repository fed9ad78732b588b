"""Poses at any stamp: positions on the straight line, rotations on the great circle."""

import gtsam
import numpy as np
import pytest

from slam_backend.core.geometry import matrix_of, seven_of_matrix
from slam_backend.core.trajectory import Snapshot, Trajectory


def drive(rng, count=20, scale=1.0) -> tuple[Trajectory, list[gtsam.Pose3]]:
    stamps = np.cumsum(rng.integers(1, 10**9, size=count)) + 1_700_000_000 * 10**9
    poses = [gtsam.Pose3.Expmap(rng.normal(size=6) * scale) for _ in range(count)]
    return Trajectory(stamps, seven_of_matrix(np.stack([pose.matrix() for pose in poses]))), poses


@pytest.mark.parametrize("scale", [2.0, 0.1, 1e-5, 1e-9])
def test_between_two_poses_the_rotation_is_gtsams_slerp_and_the_position_linear(scale):
    """Large turns, whose quaternions may point to opposite sides, and steps far below a microradian."""
    rng = np.random.default_rng(1)
    trajectory, poses = drive(rng, scale=scale)
    wanted = rng.integers(trajectory.stamps[0], trajectory.stamps[-1], size=300)
    for stamp, seven in zip(wanted, trajectory.at(wanted), strict=True):
        left = np.searchsorted(trajectory.stamps, stamp, side="right") - 1
        a, b = poses[left], poses[left + 1]
        ratio = (stamp - trajectory.stamps[left]) / (trajectory.stamps[left + 1] - trajectory.stamps[left])
        rotation = a.rotation().slerp(ratio, b.rotation())
        position = a.translation() + ratio * (b.translation() - a.translation())
        np.testing.assert_allclose(matrix_of(seven)[:3, :3], rotation.matrix(), atol=1e-9)
        np.testing.assert_allclose(seven[:3], position, atol=1e-9)
        assert np.linalg.norm(seven[3:]) == pytest.approx(1.0)


def test_at_its_own_stamps_it_is_itself_and_outside_it_is_nan():
    trajectory, _ = drive(np.random.default_rng(2))
    np.testing.assert_allclose(matrix_of(trajectory.at(trajectory.stamps)), trajectory.poses, atol=1e-12)
    first, last = int(trajectory.stamps[0]), int(trajectory.stamps[-1])
    outside = trajectory.at([first - 1, first, last, last + 1, 0])
    np.testing.assert_array_equal(np.isnan(outside).all(axis=1), [True, False, False, True, True])


def test_stamps_beyond_the_precision_of_a_float_are_told_apart():
    start = 1_700_000_000_000_000_001
    trajectory = Trajectory(
        np.array([start, start + 10]), np.array([[0, 0, 0, 0, 0, 0, 1.0], [1, 0, 0, 0, 0, 0, 1.0]])
    )
    np.testing.assert_allclose(trajectory.at([start + 1, start + 3])[:, 0], [0.1, 0.3])


def test_a_single_pose_covers_its_own_stamp_and_none_covers_nothing():
    one = Trajectory(np.array([5]), np.array([[1.0, 2, 3, 0, 0, 0, 1]]))
    got = one.at([4, 5, 6])
    np.testing.assert_array_equal(got[1], [1, 2, 3, 0, 0, 0, 1])
    assert np.isnan(got[[0, 2]]).all()
    empty = Trajectory(np.zeros(0, np.int64), np.zeros((0, 7)))
    assert np.isnan(empty.at([1, 2])).all()
    assert empty.at([1, 2]).shape == (2, 7)
    assert len(empty) == 0


def test_the_order_of_the_question_does_not_matter():
    trajectory, _ = drive(np.random.default_rng(3))
    wanted = np.random.default_rng(4).permutation(trajectory.stamps + 17)
    np.testing.assert_array_equal(trajectory.at(wanted), [trajectory.at([stamp])[0] for stamp in wanted])


def test_a_quaternion_and_its_negative_are_the_same_rotation():
    here, there = np.array([0.0, 0.0, 0.0, 1.0]), -np.array([0.0, 0.0, np.sin(0.2), np.cos(0.2)])
    trajectory = Trajectory(np.array([0, 2]), np.array([[0, 0, 0, *here], [0, 0, 0, *there]]))
    halfway = gtsam.Rot3.Rz(0.2).matrix()
    np.testing.assert_allclose(matrix_of(trajectory.at([1]))[0, :3, :3], halfway, atol=1e-12)


def test_from_another_start_the_motion_is_the_same():
    trajectory, poses = drive(np.random.default_rng(5))
    start = seven_of_matrix(gtsam.Pose3.Expmap(np.ones(6)).matrix())
    moved = trajectory.from_start(start)
    np.testing.assert_allclose(moved.poses[0], matrix_of(start), atol=1e-12)
    for n in range(1, len(poses)):
        between = np.linalg.inv(moved.poses[0]) @ moved.poses[n]
        np.testing.assert_allclose(between, poses[0].between(poses[n]).matrix(), atol=1e-9)


def test_a_snapshot_gives_stamps_and_poses_of_its_trajectory():
    trajectory, poses = drive(np.random.default_rng(6), count=3)
    shot = Snapshot(trajectory, np.arange(3), trajectory, (), np.zeros((0, 3)), 0)
    assert shot.stamps is trajectory.stamps
    np.testing.assert_allclose(shot.poses, [pose.matrix() for pose in poses], atol=1e-12)
