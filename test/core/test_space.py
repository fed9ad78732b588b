"""Both spaces speak ROS's numbers and gtsam's tangents, and their observations equal the native factors' own."""

from math import pi

import gtsam
import numpy as np
import pytest

from slam_backend.core.space import SPACES, interpolate

FLAT, FULL = SPACES["2d"], SPACES["3d"]
BOTH = pytest.mark.parametrize("space", [FLAT, FULL], ids=["2d", "3d"])


def some_pose(space, rng, scale=1.0):
    return space.expmap(rng.normal(size=space.dimension) * scale)


def turned(pose: gtsam.Pose3, rotation: np.ndarray, shift: np.ndarray) -> gtsam.Pose3:
    """A pose with an error as ROS means it: about and along the fixed axes of the parent."""
    return gtsam.Pose3(gtsam.Rot3.Expmap(rotation) * pose.rotation(), pose.translation() + shift)


def test_planar_covariance_is_that_of_the_tangent_when_the_parent_axes_are_perturbed(agree, spread):
    rng = np.random.default_rng(1)
    truth = gtsam.Pose2(4.0, -1.0, 2.2)
    block = spread(rng, [0.03, 0.01, 0.008])
    ros = np.diag([1.0, 1.0, np.nan, 1e12, 0.0, 1.0])  # what stands on the other axes does not matter
    ros[np.ix_(FLAT.used, FLAT.used)] = block
    errors = rng.multivariate_normal(np.zeros(3), block, size=20_000)
    tangents = [
        gtsam.Pose2.Logmap(truth.between(gtsam.Pose2(truth.x() + x, truth.y() + y, truth.theta() + yaw)))
        for x, y, yaw in errors
    ]
    agree(tangents, FLAT.covariance(ros.ravel(), truth))


def test_spatial_covariance_is_that_of_the_tangent_when_the_parent_axes_are_perturbed(agree, spread):
    rng = np.random.default_rng(2)
    truth = gtsam.Pose3(gtsam.Rot3.RzRyRx(-0.8, 0.5, 1.1), np.array([1.0, 2.0, 3.0]))
    ros = spread(rng, [0.02, 0.01, 0.04, 0.004, 0.012, 0.008])
    errors = rng.multivariate_normal(np.zeros(6), ros, size=20_000)
    tangents = [gtsam.Pose3.Logmap(truth.between(turned(truth, e[3:], e[:3]))) for e in errors]
    agree(tangents, FULL.covariance(ros.ravel(), truth))


def test_twist_covariance_only_changes_the_order(spread):
    """A twist is stated along the child's axes already."""
    ros = spread(np.random.default_rng(3), np.arange(1.0, 7.0))
    order = [3, 4, 5, 0, 1, 2]
    np.testing.assert_array_equal(FULL.twist_covariance(ros.ravel()), ros[np.ix_(order, order)])
    np.testing.assert_array_equal(FLAT.twist_covariance(ros.ravel()), ros[np.ix_([0, 1, 5], [0, 1, 5])])


@BOTH
def test_poses_survive_the_way_through_their_numbers(space):
    """Bit by bit where the space says so: in 3-D. A plane's angle may lose its last bit."""
    assert space.exact == (space is FULL)
    rng = np.random.default_rng(4)
    for _ in range(100):
        pose = some_pose(space, rng, 3.0)
        again = space.pose_of_numbers(space.numbers(pose))
        np.testing.assert_allclose(again.matrix(), pose.matrix(), rtol=0, atol=0 if space.exact else 1e-15)


@BOTH
def test_seven_and_pose_are_inverse_and_extrinsics_mean_the_same(space):
    rng = np.random.default_rng(5)
    pose = some_pose(space, rng)
    assert space.pose(space.seven(pose)).equals(pose, 1e-12)
    yawed = space.from_extrinsics((1.0, 2.0, 0.0, 0.0, 0.0, 0.7))
    assert yawed.equals(space.pose((1.0, 2.0, 0.0, 0.0, 0.0, np.sin(0.35), np.cos(0.35))), 1e-12)
    values = gtsam.Values()
    values.insert(1, pose)
    np.testing.assert_allclose(space.sevens(values, [1]), [space.seven(pose)], atol=1e-12)
    assert space.sevens(values, []).shape == (0, 7)


def test_extrinsics_are_roll_pitch_yaw_about_fixed_axes():
    pose = FULL.from_extrinsics((1.0, 2.0, 3.0, 0.1, 0.2, 0.3))
    expected = gtsam.Rot3.Rz(0.3) * gtsam.Rot3.Ry(0.2) * gtsam.Rot3.Rx(0.1)
    assert pose.rotation().equals(expected, 1e-12)


def test_a_plane_sees_the_yaw_of_a_tilted_pose():
    tilted = FULL.seven(gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 1.3), np.array([1.0, 2.0, 3.0])))
    assert FLAT.pose(tilted).equals(gtsam.Pose2(1.0, 2.0, 1.3), 1e-12)


@BOTH
def test_size_is_the_length_and_the_angle(space):
    pose = space.from_extrinsics((3.0, 4.0, 0.0, 0.0, 0.0, -0.6))
    assert space.size(pose) == pytest.approx((5.0, 0.6))


@BOTH
def test_interpolation_is_along_the_constant_twist(space):
    rng = np.random.default_rng(6)
    start, twist = some_pose(space, rng), rng.normal(size=space.dimension) * 0.3
    end = start.compose(space.expmap(twist))
    for ratio in (0.0, 0.25, 1.0):
        expected = start.compose(space.expmap(ratio * twist))
        assert interpolate(space, start, end, ratio).equals(expected, 1e-9)


def test_information_of_a_graph_file_takes_the_dimension_of_the_space(spread):
    rng = np.random.default_rng(7)
    three, six = np.linalg.inv(spread(rng, [0.1, 0.2, 0.3])), np.linalg.inv(spread(rng, np.full(6, 0.1)))
    assert FLAT.information(three) is three
    assert FULL.information(six) is six
    marginal = np.linalg.inv(six)[np.ix_([3, 4, 2], [3, 4, 2])]
    np.testing.assert_allclose(np.linalg.inv(FLAT.information(six)), marginal, rtol=1e-9)
    np.testing.assert_allclose(FLAT.information(FULL.information(three)), three, rtol=1e-9)


@BOTH
def test_diagonal_has_rotation_and_translation_where_the_tangent_has_them(space):
    diagonal = np.diag(space.diagonal(4.0, 9.0))
    expected = [9.0, 9.0, 4.0] if space is FLAT else [4.0] * 3 + [9.0] * 3
    np.testing.assert_array_equal(diagonal, expected)


# -- bearing and range -------------------------------------------------------------------------------------------


def seen_errors(space, point, samples, observe):
    """Errors of the native factor, at its own tangent, when the true point is seen as each sample says."""
    values = gtsam.Values()
    values.insert(1, space.identity)
    values.insert(2, point)
    unit = gtsam.noiseModel.Unit.Create
    return [observe(1, 2, value, unit(len(value))).unwhitenedError(values) for value in samples]


POINTS = {"2d": [[3.0, -2.0], [-4.0, 0.5]], "3d": [[3.0, -2.0, 1.0], [-0.5, 4.0, -3.0], [0.3, 0.2, 5.0]]}
SPREADS = {"2d": ([0.004, 0.012], [0.002, 0.01]), "3d": ([0.004, 0.012, 0.002], [0.002, 0.0006, 0.01])}
CASES = pytest.mark.parametrize(
    ("name", "point"), [(name, point) for name in POINTS for point in POINTS[name]]
)


@CASES
def test_position_becomes_bearing_and_range_at_the_tangent_of_the_native_factor(name, point, agree, spread):
    space, rng, point = SPACES[name], np.random.default_rng(8), np.array(point)
    covariance = spread(rng, SPREADS[name][0])
    seen = rng.multivariate_normal(point, covariance, size=8_000)
    value, carried = space.to_polar(point, covariance)
    np.testing.assert_allclose(space.to_cartesian(value, np.eye(len(point)))[0], point, atol=1e-12)
    agree(seen_errors(space, point, [space.to_polar(s, covariance)[0] for s in seen], space.observe), carried)


@CASES
def test_bearing_and_range_become_a_position(name, point, agree, spread):
    space, rng, point = SPACES[name], np.random.default_rng(9), np.array(point)
    covariance = spread(rng, SPREADS[name][1])
    value, _ = space.to_polar(point, covariance)
    seen = rng.multivariate_normal(value, covariance, size=8_000)
    there, carried = space.to_cartesian(value, covariance)
    np.testing.assert_allclose(there, point, atol=1e-12)
    agree([space.to_cartesian(s, covariance)[0] - point for s in seen], carried)


@CASES
def test_noise_of_angles_is_carried_to_the_tangent_of_the_native_factors(name, point, agree, spread):
    space, rng, point = SPACES[name], np.random.default_rng(10), np.array(point)
    covariance = spread(rng, SPREADS[name][1])
    value, _ = space.to_polar(point, covariance)
    seen = rng.multivariate_normal(value, covariance, size=8_000)
    agree(seen_errors(space, point, seen, space.observe), space.bearing_noise(value, covariance))
    only = covariance[:-1, :-1]
    tangents = [error[:-1] for error in seen_errors(space, point, seen, space.observe)]
    agree(tangents, space.bearing_noise(value[:-1], only))


@pytest.mark.parametrize("signs", [(1, 1, 1), (1, -1, 1), (-1, 1, -1)])
def test_a_position_on_the_diagonal_has_its_noise_in_the_basis_of_its_own_bearing(signs):
    """Where components tie, rounding decides which basis a direction has; both must come from one direction."""
    for length in np.random.default_rng(11).uniform(1, 9, size=50):
        point = length * np.array(signs, dtype=float)
        value, carried = FULL.to_polar(point, np.diag([1.0, 4.0, 9.0]))
        basis = gtsam.Unit3(FULL.direction(value[0], value[1])).basis()
        expected = basis.T @ np.diag([1.0, 4.0, 9.0]) @ basis / (3 * length**2)
        np.testing.assert_allclose(carried[:2, :2], expected, rtol=1e-9)


@pytest.mark.parametrize("elevation", [pi / 2, -pi / 2, pi / 2 - 1e-9])
def test_a_bearing_straight_up_still_has_a_definite_noise(elevation):
    """There the azimuth has no effect, and a singular covariance would ruin the factor."""
    noise = FULL.bearing_noise(np.array([0.3, elevation]), np.diag([1e-4, 1e-4]))
    smallest, largest = np.linalg.eigvalsh(noise)
    assert largest == pytest.approx(1e-4)
    assert 1e-11 < smallest < largest
