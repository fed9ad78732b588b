"""Landmarks are as wrong as they say: Monte-Carlo over all forms, in both spaces."""

from math import atan2, hypot

import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.graph import Pose
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.robust.chi2 import chi2_quantile
from slam_backend.core.sensors.landmark import LandmarkObservation
from slam_backend.core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from slam_backend.core.space import SPACES, Space

STEPS = 8
SIGMA_TRANSLATION, SIGMA_ROTATION = 0.05, 0.02  # m, rad after 1 m
SIGMA_POSITION, SIGMA_BEARING, SIGMA_RANGE = 0.1, 0.02, 0.15
LANDMARKS = np.array([[4.0, 3.0, 1.0], [2.0, -4.0, -1.0], [7.0, 2.0, 0.5], [9.0, -3.0, 1.5]])
FORMS = [(space, form) for space in ("2d", "3d") for form in ("position", "bearing_range", "pose")]
PLACELESS = [(space, form) for space in ("2d", "3d") for form in ("bearing", "range")]
LONG = 30  # steps; they are placed on the way


def sighting(
    rng: np.random.Generator, form: str, stamp: int, name: str, point: np.ndarray
) -> LandmarkObservation:
    """A point in the frame of the base, with the noise that its covariance states."""
    if form == "position":
        value, sigmas = point, np.full(3, SIGMA_POSITION)
    else:
        x, y, z = point
        value = np.array([atan2(y, x), atan2(z, hypot(x, y)), np.linalg.norm(point)])
        sigmas = np.array([SIGMA_BEARING, SIGMA_BEARING, SIGMA_RANGE])
    if form in ("bearing", "range"):
        value, sigmas = (value[:2], sigmas[:2]) if form == "bearing" else (value[2:], sigmas[2:])
    noisy = value + sigmas * rng.normal(size=len(value))
    return LandmarkObservation(stamp, "trees", "", name, form, frozen(noisy), frozen(np.diag(sigmas**2)))


def sighting_of_tag(
    rng: np.random.Generator, space: Space, stamp: int, name: str, tag: Pose
) -> LandmarkObservation:
    """A tag in the frame of the base, its noise about the fixed axes of that frame."""
    stated = np.diag([SIGMA_POSITION**2] * 3 + [SIGMA_BEARING**2] * 3)
    noise = rng.multivariate_normal(np.zeros(space.dimension), space.covariance(stated.ravel(), tag))
    value = frozen(space.seven(tag.compose(space.expmap(noise))))
    return LandmarkObservation(stamp, "trees", "", name, "pose", value, frozen(stated))


def twist(space: str, form: str, k: int) -> np.ndarray:
    """Of the step to keyframe k. Ranges alone need a way that leaves the plane for good, or they do not tell above from below."""
    if space == "2d":
        return np.array([1.0, 0, 0.1])
    if form == "range":
        return np.array([0.05 * np.sin(k / 3), 0.25 * np.cos(k / 4), 0.15, 1.0, 0, 0])
    return np.array([0.03, -0.02, 0.1, 1.0, 0, 0])


def nees(space_name: str, form: str, seed: int, steps: int = STEPS) -> float | None:
    """Squared Mahalanobis distance of the last pose and the first landmark together; None while that is not placed."""
    rng, space = np.random.default_rng(seed), SPACES[space_name]
    wheels = {
        "kind": "odometry",
        "sigma_translation_per_meter": SIGMA_TRANSLATION,
        "sigma_rotation_per_meter": SIGMA_ROTATION,
    }
    none = {"sigma_translation_per_radian": 0.0, "sigma_rotation_per_radian": 0.0}
    backend = Backend(config_from({
        "space": space_name, "keyframes": {"every": True}, "sources": ["wheels", "trees"],
        "wheels": wheels | none, "trees": {"kind": "landmark"},
    }))  # fmt: skip
    points = LANDMARKS[:, : space.point_dimension] * 1.0
    tags = [space.from_extrinsics((*point, 0.2, -0.1, n)) for n, point in enumerate(LANDMARKS)]
    variances = space.diagonal(SIGMA_ROTATION**2, SIGMA_TRANSLATION**2)
    truth = told = space.identity
    for k in range(steps):
        stamp = (k + 1) * SECOND
        if k:
            step = space.expmap(twist(space_name, form, k))
            truth = truth.compose(step)
            told = told.compose(step).compose(
                space.expmap(rng.multivariate_normal(np.zeros(space.dimension), variances))
            )
        for n, point in enumerate(points):
            if form == "pose":
                backend.add(sighting_of_tag(rng, space, stamp, str(n), truth.inverse().compose(tags[n])))
                continue
            seen = np.zeros(3)
            seen[: space.point_dimension] = truth.transformTo(point)
            backend.add(sighting(rng, form, stamp, str(n), seen))
        backend.add(
            OdometryPose(stamp, "wheels", "odom", "base", frozen(space.seven(told)), UNKNOWN, STILL, UNKNOWN)
        )
    backend.finish()
    backend.polish()
    keys = [backend.timeline.keyframes[-1].pose, backend.landmark("0")]
    if not backend.estimate.knows(keys[1]):
        return None
    pose, found = backend.estimate.pose(keys[0]), backend.estimate.value(keys[1])
    off = space.logmap(found.between(tags[0])) if form == "pose" else points[0] - found
    error = np.concatenate([space.logmap(pose.between(truth)), off])
    return float(error @ np.linalg.solve(backend.estimate.covariance(keys), error))


def consistent(space: str, form: str, runs: int, steps: int = STEPS) -> None:
    found = [each for seed in range(runs) if (each := nees(space, form, seed, steps)) is not None]
    assert len(found) >= 0.9 * runs
    mean = np.mean(found)
    sizes = SPACES[space]
    dof = sizes.dimension + (sizes.dimension if form == "pose" else sizes.point_dimension)
    low, high = (chi2_quantile(p, dof * len(found)) / len(found) for p in (0.0005, 0.9995))
    assert low < mean < high


@pytest.mark.parametrize(("space", "form"), FORMS)
def test_pose_and_landmark_are_as_wrong_as_they_say(space: str, form: str) -> None:
    """A few runs: the mean of the squared Mahalanobis distance within its 99.9 % bounds."""
    consistent(space, form, 12)


@pytest.mark.slow
@pytest.mark.parametrize(("space", "form"), FORMS)
def test_pose_and_landmark_are_as_wrong_as_they_say_in_200_runs(space: str, form: str) -> None:
    """Narrower bounds, by as many runs."""
    consistent(space, form, 200)


@pytest.mark.slow
@pytest.mark.parametrize(("space", "form"), PLACELESS)
def test_what_many_sightings_place_is_as_wrong_as_it_says_in_200_runs(space: str, form: str) -> None:
    """By range or by bearing alone. By then nearly all runs have placed it, and none believes a mirror image."""
    consistent(space, form, 200, LONG)
