"""Points from pixels: exact where nothing errs, as certain as they say where something does, and derivatives that are ones."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from slam_backend.core.config import PixelsSource
from slam_backend.core.sensors.frames import Frame
from slam_backend.core.sensors.reprojection import Reprojection
from slam_backend.core.sensors.resection import Known, judged
from slam_backend.core.sensors.triangulation import (
    Lens,
    Sightings,
    by_tangent,
    covariances,
    images,
    of_image,
    ratios,
    triangulated,
)
from slam_backend.lab.world import exp_of

MONO = Lens(400.0, 410.0, 320.0, 240.0)
STEREO = MONO._replace(baseline=0.3)
LENSES = pytest.mark.parametrize("lens", [MONO, STEREO], ids=["mono", "stereo"])


def views(count: int) -> np.ndarray:
    """Cameras that go forward and sideways, turning a little."""
    tangents = np.array([[0.01 * k, -0.02 * k, 0.01 * k, 0.3 * k, 0.1 * k, 0.2 * k] for k in range(count)])
    return exp_of(tangents)


def seen(
    points: np.ndarray, lens: Lens, count: int, sigma: float = 1.0, rng=None, covariance=None
) -> Sightings:
    """Each point by each of some cameras; with noise in the pixels, and in the poses by a covariance."""
    poses = np.tile(views(count), (len(points), 1, 1))
    true = (
        poses
        if covariance is None
        else poses @ exp_of(rng.multivariate_normal(np.zeros(6), covariance, len(poses)))
    )
    pixels, _ = images(np.repeat(points, count, axis=0), true, lens)
    if rng is not None:
        pixels = pixels + sigma * rng.standard_normal(pixels.shape)
    if not lens.baseline:
        pixels[:, 2] = np.nan
    noises = None if covariance is None else np.tile(covariance, (len(poses), 1, 1))
    return Sightings(np.arange(len(points)) * count, poses, pixels, np.full(len(poses), sigma), noises)


@LENSES
def test_without_noise_points_are_where_they_are(lens):
    """Near, far, and beside the axis."""
    points = np.array([[0.5, -0.2, 3.0], [-4.0, 2.0, 12.0], [10.0, -5.0, 60.0]])
    found = triangulated(seen(points, lens, 4), lens)
    np.testing.assert_allclose(found.points, points, rtol=1e-7)
    np.testing.assert_allclose(found.chi2, 0.0, atol=1e-8)
    np.testing.assert_array_equal(found.freedom, 4 * (3 if lens.baseline else 2) - 3)


def test_what_is_behind_or_at_infinity_has_no_place():
    """A direction that every camera sees the same, and an image that only a point behind could make."""
    far = np.array([[1e9, 0.0, 5e9]])
    assert triangulated(seen(far, MONO, 4), MONO).share[0] > 10
    mirrored = seen(np.array([[1.0, 0.5, 6.0]]), MONO, 2)
    pixels = mirrored.pixels.copy()
    pixels[1] = 2 * pixels[0] - pixels[1]  # the parallax the other way round
    assert triangulated(mirrored._replace(pixels=pixels), MONO).share[0] == np.inf


@LENSES
@pytest.mark.parametrize("loose", [False, True], ids=["exact_poses", "loose_poses"])
def test_the_disagreement_is_chi_square_and_the_share_is_honest(lens, loose):
    """Over 4000 points: the mean of chi2 over its freedom, and of the squared error of the distance over what is stated."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-3, 3, 4000), rng.uniform(-2, 2, 4000), rng.uniform(8, 12, 4000)])
    covariance = np.diag([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3]) ** 2 if loose else None
    sightings = seen(points, lens, 4, 0.7, rng, covariance)
    found = triangulated(sightings, lens)
    assert found.chi2.sum() / found.freedom.sum() == pytest.approx(1.0, abs=0.03)
    if not loose:  # the first camera's own error moves the point with it
        errors = np.linalg.norm(found.points, axis=1) / np.linalg.norm(points, axis=1) - 1
        assert np.mean((errors / found.share) ** 2) == pytest.approx(1.0, abs=0.08)
        away = found.points - points
        stated = covariances(found.points, sightings, lens)
        nees = np.einsum("ni,nij,nj->n", away, np.linalg.inv(stated), away)
        assert nees.mean() == pytest.approx(3.0, abs=0.2)


def test_derivatives_are_those_of_the_image():
    """By central differences: of the point in the camera, and of the camera's tangent."""
    rng = np.random.default_rng(1)
    points, poses = rng.uniform([-1, -1, 3], [1, 1, 8], (20, 3)), np.tile(np.eye(4), (20, 1, 1))
    shown = ratios(points.T, STEREO.baseline)
    by_pose = of_image(shown, points[:, 2], by_tangent(points.T), STEREO).transpose(2, 0, 1)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        ends = [images(points, poses @ exp_of(sign * step[None])[0], STEREO)[0] for sign in (1, -1)]
        np.testing.assert_allclose(by_pose[:, :, k], (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=1e-3)


@LENSES
def test_images_and_derivatives_are_gtsams(lens):
    """Of a mounted camera, pixel by pixel: the error of the factor, and its Jacobian by the pose of the body and by the point."""
    rng = np.random.default_rng(2)
    body = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.7), np.array([1.0, -2.0, 0.4]))
    mount = gtsam.Pose3(gtsam.Rot3.RzRyRx(-1.5, 0.1, -1.6), np.array([0.2, 0.1, 0.3]))
    camera = body.compose(mount)
    local = rng.uniform([-3, -2, 2], [3, 2, 20], (40, 3))
    points = np.array([camera.transformFrom(each) for each in local])
    pixels = rng.uniform(0, 600, (40, 3)) if lens.baseline else np.full((40, 3), np.nan)
    pixels[:, :2] = rng.uniform(0, 600, (40, 2))
    expected, _ = images(points, np.tile(camera.matrix(), (40, 1, 1)), lens)
    known = Known(points, np.zeros((40, 3, 3)), pixels, np.full(40, 0.5))
    error, jacobian, chi2 = judged(camera, known, lens)
    frame = Frame("f", 0, X(0), mount, lens, np.arange(40), pixels, np.full(40, 0.5))
    rows = [0, 2, 1] if lens.baseline else [0, 1]  # gtsam's order of a stereo pixel
    by_body, values = mount.inverse().AdjointMap(), gtsam.Values()
    values.insert(X(0), body)
    values.insert(L(0), np.zeros(3))
    for n in range(40):
        values.update(L(0), points[n])
        factor = Reprojection(PixelsSource()).of_point(n, frame, n, L(0)).factor
        np.testing.assert_allclose(
            factor.unwhitenedError(values), (expected - pixels)[n, rows], rtol=1e-9, atol=1e-9
        )
        matrix, _ = factor.linearize(values).jacobian()
        np.testing.assert_allclose(jacobian[rows, :, n] @ by_body, matrix[:, :6], rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(error[rows, n], -factor.whitenedError(values), rtol=1e-9, atol=1e-9)
        assert chi2[n] == pytest.approx(2 * factor.error(values))


@LENSES
def test_what_gtsam_finds_behind_a_camera_is_behind_it(lens):
    """Points all around: where gtsam's camera throws, and nowhere else, a point has no chi-square and moves nothing."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-5, 5, (60, 3))
    pixels = np.full((60, 3), 100.0)
    if not lens.baseline:
        pixels[:, 2] = np.nan
    calibration = (lens.fx, lens.fy, 0.0, lens.cx, lens.cy)

    def is_behind(point):
        try:
            if lens.baseline:
                gtsam.StereoCamera(gtsam.Pose3(), gtsam.Cal3_S2Stereo(*calibration, lens.baseline)).project(
                    point
                )
            else:
                gtsam.PinholeCameraCal3_S2(gtsam.Pose3(), gtsam.Cal3_S2(*calibration)).project(point)
        except RuntimeError:
            return True
        return False

    behind = np.array([is_behind(point) for point in points])
    assert 10 < behind.sum() < 50
    known = Known(points, np.tile(np.eye(3), (60, 1, 1)), pixels, np.ones(60))
    _, jacobian, chi2 = judged(gtsam.Pose3(), known, lens, np.eye(6) * 1e-4)
    np.testing.assert_array_equal(np.isinf(chi2), behind)
    assert not jacobian[:, :, behind].any()
    assert jacobian[:, :, ~behind].any(axis=(0, 1)).all()
