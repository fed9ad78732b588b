"""The pose of a camera from points that are known, some of them seen wrongly: robust, beside what the odometry says."""

from typing import NamedTuple

import numpy as np

from ..graph import Motion, Pose
from ..measurement import Array
from .symmetric import products, times
from .triangulation import Lens, by_tangent, of_image, pixels_of, ratios, whitening

STEPS = 8  # of Gauss-Newton
CAUCHY = 2.3849  # standard deviations: 95 % efficiency where all is well
FEWEST = 8  # sightings of known points below which only the odometry is believed
AGREED = 0.5  # of them must agree with what is found


class Known(NamedTuple):
    """(N,) sightings of known points: points (N, 3) in the map, covariances (N, 3, 3), pixels (N, 3), sigmas (N,)."""

    points: Array
    covariances: Array
    pixels: Array
    sigmas: Array


def resected(prior: Motion, body_T_camera: Pose, known: Known, lens: Lens) -> Motion:
    """`map_T_base`, most likely, with its covariance; the prior itself where the points say too little, or contradict each other."""
    if len(known.sigmas) < FEWEST:
        return prior
    to_camera = body_T_camera.inverse().AdjointMap()
    information = np.linalg.inv(prior.covariance)
    pose, weights, curvature = prior.pose, np.zeros(len(known.sigmas)), information
    for _ in range(STEPS):
        error, jacobian, chi2 = judged(pose.compose(body_T_camera), known, lens)
        weights = 1 / (1 + chi2 / CAUCHY**2)
        columns = (to_camera.T @ jacobian).swapaxes(0, 1)
        weighted = (columns * weights).reshape(6, -1)
        curvature = information + weighted @ columns.reshape(6, -1).T
        away = type(pose).Logmap(prior.pose.between(pose))
        gradient = weighted @ error.ravel() - information @ away
        step = np.linalg.solve(curvature, gradient)
        pose = pose.retract(step)
        if np.abs(step).max() < 1e-6:
            break
    if np.mean(weights > 0.5) < AGREED:
        return prior
    return Motion(pose, np.linalg.inv(curvature))


def judged(
    map_T_camera: Pose, known: Known, lens: Lens, pose_covariance: Array | None = None
) -> tuple[Array, Array, Array]:
    """Whitened errors (3, N), Jacobian (3, 6, N) by the camera's tangent, chi-square (N,); infinite where the point is behind.

    pose_covariance: at the camera's tangent; None: the pose is exact.
    """
    turn, place = map_T_camera.rotation().matrix(), map_T_camera.translation()
    local = np.ascontiguousarray(((known.points - place) @ turn).T)
    mono, behind = ~np.isfinite(known.pixels[:, 2]), local[2] <= 0
    with np.errstate(all="ignore"):
        shown = ratios(local, lens.baseline)
        by_point = of_image(shown, local[2], turn.T[:, :, None], lens)
        by_pose = of_image(shown, local[2], by_tangent(local), lens)
        error = known.pixels.T - pixels_of(shown, lens)
    for each in (by_point, by_pose, error):
        each[2, ..., mono] = 0.0
        each[..., behind] = 0.0
    noises = np.ascontiguousarray(known.covariances.transpose(1, 2, 0))
    spread = (by_point[:, :, None] * noises).sum(axis=1)
    noise = products(spread, by_point)
    if pose_covariance is not None:
        noise += products(pose_covariance @ by_pose, by_pose)
    root = whitening(noise, known.sigmas)
    error = times(root, error)
    return error, times(root, by_pose), np.where(behind, np.inf, (error**2).sum(axis=0))
