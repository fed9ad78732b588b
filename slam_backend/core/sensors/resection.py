"""The pose of a camera from points that are known, some of them seen wrongly: robust, beside what the odometry says."""

from typing import NamedTuple

import numpy as np

from ..graph import Motion, Pose
from ..measurement import Array
from .triangulation import Lens, cross, images, of_image, whitening

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
        jacobian = jacobian @ to_camera
        weighted = np.swapaxes(jacobian, 1, 2) * weights[:, None, None]
        curvature = information + (weighted @ jacobian).sum(axis=0)
        away = type(pose).Logmap(prior.pose.between(pose))
        gradient = (weighted @ error[:, :, None]).sum(axis=0)[:, 0] - information @ away
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
    """Whitened errors (N, 3), Jacobian (N, 3, 6) by the camera's tangent, chi-square (N,); infinite where the point is behind.

    pose_covariance: at the camera's tangent; None: the pose is exact.
    """
    poses = np.broadcast_to(map_T_camera.matrix(), (len(known.sigmas), 4, 4))
    expected, local = images(known.points, poses, lens)
    stereo = np.isfinite(known.pixels[:, 2])
    behind = local[:, 2] <= 0
    with np.errstate(all="ignore"):
        by_point = of_image(local, lens, lens.baseline)
    by_point[~stereo, 2] = 0.0
    by_point[behind] = 0.0
    error = np.where(behind[:, None], 0.0, known.pixels - expected)
    error[~stereo, 2] = 0.0
    by_pose = np.concatenate([by_point @ cross(local), -by_point], axis=2)
    in_camera = by_point @ poses[:, :3, :3].swapaxes(1, 2)
    noise = in_camera @ known.covariances @ np.swapaxes(in_camera, 1, 2)
    if pose_covariance is not None:
        noise = noise + by_pose @ pose_covariance @ np.swapaxes(by_pose, 1, 2)
    root = whitening(noise, known.sigmas)
    error = (root @ error[:, :, None])[:, :, 0]
    return error, root @ by_pose, np.where(behind, np.inf, (error**2).sum(axis=1))
