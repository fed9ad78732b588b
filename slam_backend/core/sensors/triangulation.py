"""Points from pixels, all tracks of a frame at once: where a point is, how well that is known, and whether its sightings agree.

A point is sought by direction and inverse distance in the camera that saw it first (Civera, Davison & Montiel, T-RO 2008): there
the problem is nearly linear, and a point at infinity is a number like any other. With the pose of the camera that saw it first,
(a, b, r) is the point (a, b, 1) / r; in another camera its image is that of q = R (a, b, 1) + t r.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..measurement import Array

Rows = NDArray[np.intp]

STEPS = 6  # of Gauss-Newton; from the linear solution two or three do
NEAR = 1e-3  # of the image's distance: what lies nearer to a camera's plane, or behind it, has no image


class Lens(NamedTuple):
    """A pinhole. fx, fy, cx, cy: pixels; baseline: m, from the left to the right camera, 0 for one that is alone."""

    fx: float
    fy: float
    cx: float
    cy: float
    baseline: float = 0.0


class Sightings(NamedTuple):
    """(N,) sightings, those of one track after the other.

    starts: (T,) the first row of each track. poses: (N, 4, 4) map_T_camera, optical axes (z ahead, x right, y down).
    pixels: (N, 3) u, v, and u in the right camera (NaN: not seen there). sigmas: (N,) pixels.
    covariances: (N, 6, 6) of the camera's pose at its own tangent, rotation first; None: the poses are exact.
    """

    starts: Rows
    poses: Array
    pixels: Array
    sigmas: Array
    covariances: Array | None = None

    @property
    def tracks(self) -> Rows:
        """(N,) the track of each sighting."""
        counts = np.diff(np.append(self.starts, len(self.sigmas)))
        return np.repeat(np.arange(len(self.starts)), counts)

    @property
    def stereo(self) -> NDArray[np.bool_]:
        """(N,) whether the right camera saw it too."""
        return np.isfinite(self.pixels[:, 2])

    def only(self, which: NDArray[np.bool_]) -> "Sightings":
        """Those of some of the (T,) tracks."""
        rows = which[self.tracks]
        counts = np.diff(np.append(self.starts, len(rows)))[which]
        noises = None if self.covariances is None else self.covariances[rows]
        return Sightings(
            np.cumsum(counts) - counts, self.poses[rows], self.pixels[rows], self.sigmas[rows], noises
        )


class Points(NamedTuple):
    """(T,) tracks. points: (T, 3) in the map. share: standard deviation of the distance as a part of it, infinite for a point
    that is behind a camera or may as well be at infinity. chi2, freedom: of the sightings' disagreement.
    """

    points: Array
    share: Array
    chi2: Array
    freedom: Array


class _Views(NamedTuple):
    """From the camera that saw a track first to each that saw it: turns (N, 3, 3), shifts (N, 3). tracks (N,), stereo (N,)."""

    turns: Array
    shifts: Array
    tracks: Rows
    stereo: NDArray[np.bool_]


def triangulated(seen: Sightings, lens: Lens) -> Points:
    """The most likely point of each track, and what is to be thought of it. Poses are taken as they are, up to their covariances."""
    views, starts = _views(seen), seen.starts
    state = _linear(seen, lens, views)
    weights = np.eye(3) / seen.sigmas[:, None, None]
    with np.errstate(all="ignore"):  # a track without a solution is found out at the end
        for n in range(STEPS):
            error, jacobian, q = _projected(state, seen.pixels, lens, views)
            if n == STEPS // 2 and seen.covariances is not None and seen.covariances.any():
                weights = _whitening(seen, _by_pose(q, state[views.tracks, 2], lens, views.stereo))
            step, _ = _solved(weights @ jacobian, _apply(weights, error), starts)
            state = state + np.where(np.isfinite(step), step, 0.0)
        error, jacobian, q = _projected(state, seen.pixels, lens, views)
        error = _apply(weights, error)
        _, information = _solved(weights @ jacobian, error, starts)
        chi2, sigma = (
            np.add.reduceat((error**2).sum(axis=1), starts),
            np.sqrt(np.linalg.inv(information)[:, 2, 2]),
        )
        inverse, ahead = state[:, 2], np.minimum.reduceat(q[:, 2], starts) > NEAR
        good = (inverse > 0) & ahead & np.isfinite(sigma) & np.isfinite(chi2)
        rays = np.column_stack([state[:, :2], np.ones(len(state))]) / inverse[:, None]
        points = (seen.poses[starts, :3, :3] @ rays[:, :, None])[:, :, 0] + seen.poses[starts, :3, 3]
        share = np.where(good, sigma / inverse, np.inf)
    return Points(points, share, chi2, np.add.reduceat(2.0 + views.stereo, starts) - 3)


def images(points: Array, poses: Array, lens: Lens) -> tuple[Array, Array]:
    """(N, 3) u, v, and u in the right camera, of (N, 3) points seen from (N, 4, 4) map_T_camera; (N, 3) the points in the camera."""
    local = _local(points, poses)
    with np.errstate(all="ignore"):
        return _image(local, lens, np.ones(len(local))), local


def covariances(points: Array, seen: Sightings, lens: Lens) -> Array:
    """(T, 3, 3) in the map, of (T, 3) points by their sightings alone, from cameras that stand where they stand."""
    with np.errstate(all="ignore"):
        local = _local(points[seen.tracks], seen.poses)
        by_point = of_image(local, lens, lens.baseline) @ np.swapaxes(seen.poses[:, :3, :3], 1, 2)
    by_point = np.nan_to_num(by_point) / seen.sigmas[:, None, None]
    by_point[np.isnan(seen.pixels[:, 2]), 2] = 0.0
    information = np.add.reduceat(np.swapaxes(by_point, 1, 2) @ by_point, seen.starts)
    information[:, range(3), range(3)] += 1e-9 * np.trace(information, axis1=1, axis2=2)[:, None] + 1e-12
    return np.linalg.inv(information)


def _local(points: Array, poses: Array) -> Array:
    return np.asarray((points - poses[:, :3, 3])[:, None, :] @ poses[:, :3, :3])[:, 0]


def _image(local: Array, lens: Lens, scale: Array) -> Array:
    """Of points in the camera, times a scale by which the baseline is multiplied too."""
    x, y, z = local.T
    return np.column_stack(
        [
            lens.fx * x / z + lens.cx,
            lens.fy * y / z + lens.cy,
            lens.fx * (x - lens.baseline * scale) / z + lens.cx,
        ]
    )


def _views(seen: Sightings) -> _Views:
    tracks = seen.tracks
    first = seen.poses[seen.starts][tracks]
    back = np.swapaxes(seen.poses[:, :3, :3], 1, 2)
    shifts = (back @ (first[:, :3, 3] - seen.poses[:, :3, 3])[:, :, None])[:, :, 0]
    return _Views(back @ first[:, :3, :3], shifts, tracks, seen.stereo)


def _linear(seen: Sightings, lens: Lens, views: _Views) -> Array:
    """(T, 3): the direction as seen first, the inverse distance by least squares from all other images."""
    image = (seen.pixels - [lens.cx, lens.cy, lens.cx]) / [lens.fx, lens.fy, lens.fx]
    ray = np.column_stack([image[seen.starts, :2], np.ones(len(seen.starts))])
    q = (views.turns @ ray[views.tracks][:, :, None])[:, :, 0]
    base = np.array([[0.0, 0.0, lens.baseline]])
    gain = views.shifts[:, [0, 1, 0]] - base - image * views.shifts[:, 2:]
    wanted = image * q[:, 2:] - q[:, [0, 1, 0]]
    gain[~views.stereo, 2] = wanted[~views.stereo, 2] = 0.0
    square = np.add.reduceat((gain**2).sum(axis=1), seen.starts)
    product = np.add.reduceat((gain * wanted).sum(axis=1), seen.starts)
    inverse = product / np.maximum(square, np.finfo(float).tiny)
    return np.column_stack([ray[:, :2], np.maximum(inverse, 0.0)])


def _projected(state: Array, pixels: Array, lens: Lens, views: _Views) -> tuple[Array, Array, Array]:
    """Errors (N, 3), measured minus expected; the image's Jacobian (N, 3, 3) by the state; the point in the camera over its first
    distance (N, 3).
    """
    state, stereo = state[views.tracks], views.stereo
    rays = np.column_stack([state[:, :2], np.ones(len(state))])
    q = (views.turns @ rays[:, :, None])[:, :, 0] + views.shifts * state[:, 2:]
    error = pixels - _image(q, lens, state[:, 2])
    of_state = np.concatenate([views.turns[:, :, :2], views.shifts[:, :, None]], axis=2)
    jacobian = of_image(q, lens, lens.baseline * state[:, 2]) @ of_state
    jacobian[:, 2, 2] -= lens.fx * lens.baseline / q[:, 2]
    error[~stereo, 2] = 0.0
    jacobian[~stereo, 2] = 0.0
    return error, jacobian, q


def of_image(q: Array, lens: Lens, baseline: Array | float) -> Array:
    """(N, 3, 3) derivative of u, v, right u by the (N, 3) point in the camera, the baseline in the same scale."""
    x, y, z = q.T
    found = np.zeros((len(q), 3, 3))
    found[:, 0, 0] = found[:, 2, 0] = lens.fx / z
    found[:, 1, 1] = lens.fy / z
    found[:, 0, 2], found[:, 1, 2] = -lens.fx * x / z**2, -lens.fy * y / z**2
    found[:, 2, 2] = -lens.fx * (x - baseline) / z**2
    return found


def _by_pose(q: Array, inverse: Array, lens: Lens, stereo: NDArray[np.bool_]) -> Array:
    """(N, 3, 6) derivative of the image by the camera's tangent. inverse: (N,) of the distance, in the scale of q (N, 3)."""
    by_point = of_image(q, lens, lens.baseline * inverse)
    by_point[~stereo, 2] = 0.0
    return np.concatenate([by_point @ cross(q), -by_point * inverse[:, None, None]], axis=2)


def cross(vectors: Array) -> Array:
    """(N, 3, 3) with [v] w = v x w: how a point in the camera moves when the camera turns by w."""
    x, y, z = vectors.T
    zero = np.zeros(len(vectors))
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _whitening(seen: Sightings, by_pose: Array) -> Array:
    """(N, 3, 3) W with W^T W the information of an image whose camera stands where it stands by its covariance."""
    assert seen.covariances is not None
    noise = by_pose @ seen.covariances @ np.swapaxes(by_pose, 1, 2)
    return whitening(noise, seen.sigmas)


def whitening(noise: Array, sigmas: Array) -> Array:
    """(N, 3, 3) W with W^T W the inverse of (N, 3, 3) noise plus that of the pixels themselves, (N,). What is not finite of the
    noise is left out, and what rounding has made of directions without noise.
    """
    noise = np.where(np.isfinite(noise), noise, 0.0)
    noise[:, range(3), range(3)] += (sigmas**2)[:, None]
    try:
        return np.linalg.inv(np.linalg.cholesky(noise))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh((noise + np.swapaxes(noise, 1, 2)) / 2)
        values = np.maximum(values, (sigmas**2)[:, None])
        return np.asarray(np.swapaxes(vectors, 1, 2) / np.sqrt(values)[:, :, None])


def _apply(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def _solved(jacobian: Array, error: Array, starts: Rows) -> tuple[Array, Array]:
    """The step (T, 3) of each track, and its information (T, 3, 3), from whitened rows."""
    back = np.swapaxes(jacobian, 1, 2)
    information = np.add.reduceat(back @ jacobian, starts)
    information[:, range(3), range(3)] += 1e-12 * (1 + np.trace(information, axis1=1, axis2=2))[:, None]
    gradient = np.add.reduceat(_apply(back, error), starts)
    return np.linalg.solve(information, gradient[:, :, None])[:, :, 0], information
