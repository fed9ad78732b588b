"""A camera's pose from known points: right though a third of them are seen wrongly, and as certain as it says."""

import gtsam
import numpy as np

from slam_backend.core.graph import Motion
from slam_backend.core.sensors.resection import Known, judged, resected
from slam_backend.core.sensors.triangulation import Lens, images

LENS = Lens(400.0, 400.0, 320.0, 240.0)
MOUNT = gtsam.Pose3(gtsam.Rot3.RzRyRx(-np.pi / 2, 0.0, -np.pi / 2), np.array([0.2, 0.1, 0.0]))
TRUE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.3), np.array([1.0, 2.0, 0.5]))
LOOSE = np.diag([0.02, 0.02, 0.02, 0.2, 0.2, 0.2]) ** 2


def known(rng, count: int, wrong: float) -> Known:
    camera = TRUE.compose(MOUNT)
    local = rng.uniform([-4, -3, 5], [4, 3, 15], (count, 3))
    points = np.array([camera.transformFrom(point) for point in local])
    pixels, _ = images(points, np.tile(camera.matrix(), (count, 1, 1)), LENS)
    pixels += rng.standard_normal(pixels.shape)
    bad = rng.random(count) < wrong
    pixels[bad] = rng.random((bad.sum(), 3)) * [640, 480, 640]
    pixels[:, 2] = np.nan
    return Known(points, np.tile(np.eye(3) * 1e-6, (count, 1, 1)), pixels, np.ones(count))


def prior(rng) -> Motion:
    return Motion(TRUE.retract(rng.multivariate_normal(np.zeros(6), LOOSE)), LOOSE)


def test_wrong_sightings_do_not_move_the_pose():
    rng = np.random.default_rng(0)
    for _ in range(20):
        found = resected(prior(rng), MOUNT, known(rng, 60, 0.3), LENS)
        error = gtsam.Pose3.Logmap(found.pose.between(TRUE))
        assert np.abs(error[:3]).max() < 0.01
        assert np.abs(error[3:]).max() < 0.08


def test_it_is_as_certain_as_it_says():
    """Mean NEES over 300 poses; the weights of a robust kernel make it say a little less than it knows."""
    rng, sums = np.random.default_rng(1), []
    for _ in range(300):
        found = resected(prior(rng), MOUNT, known(rng, 40, 0.0), LENS)
        error = gtsam.Pose3.Logmap(found.pose.between(TRUE))
        sums.append(error @ np.linalg.solve(found.covariance, error))
    assert 4.0 < np.mean(sums) < 6.8


def test_few_points_or_a_contradiction_leave_the_odometry_alone():
    rng = np.random.default_rng(2)
    believed = prior(rng)
    assert resected(believed, MOUNT, known(rng, 5, 0.0), LENS) is believed
    assert resected(believed, MOUNT, known(rng, 60, 0.95), LENS) is believed


def test_a_point_behind_the_camera_cannot_be_seen():
    rng = np.random.default_rng(3)
    ahead = known(rng, 10, 0.0)
    camera = TRUE.compose(MOUNT)
    behind = np.array([camera.transformFrom(np.array([0.5, 0.5, -4.0]))])
    _, jacobian, chi2 = judged(camera, ahead._replace(points=np.vstack([behind, ahead.points[1:]])), LENS)
    assert chi2[0] == np.inf
    assert not jacobian[:, :, 0].any()
    assert np.isfinite(chi2[1:]).all()
