"""Points from pixels: exact where nothing errs, as certain as they say where something does, and derivatives that are ones."""

import numpy as np
import pytest

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
