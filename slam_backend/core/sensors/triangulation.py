"""Points from pixels, all tracks of a frame at once: where a point is, how well that is known, and whether its sightings agree.

A point is sought by direction and inverse distance in the camera that saw it first (Civera, Davison & Montiel, T-RO 2008): there
the problem is nearly linear, and a point at infinity is a number like any other. With the pose of the camera that saw it first,
(a, b, r) is the point (a, b, 1) / r; in another camera its image is that of q = R (a, b, 1) + t r.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..measurement import Array
from .symmetric import DIAGONAL, cholesky, full, inverse_factor, products, six_of, times, transposed_times
from .symmetric import inverse as symmetric_inverse

Rows = NDArray[np.intp]

STEPS = 3  # of Gauss-Newton from the linear solution, and again once the poses' covariances are taken into account
SETTLED = 1e-9  # largest step of the state after which no more is made
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
    """From the camera that saw a track first to each that saw it. moves: (3, 3, N) how q moves with the state; axis: (3, N) where it is
    at a state of zeros; tracks (N,), stereo (N,).
    """

    moves: Array
    axis: Array
    tracks: Rows
    stereo: NDArray[np.bool_]


def triangulated(seen: Sightings, lens: Lens) -> Points:
    """The most likely point of each track, and what is to be thought of it. Poses are taken as they are, up to their covariances."""
    views, starts, pixels = _views(seen), seen.starts, seen.pixels.T.copy()
    state = _linear(pixels, starts, lens, views)
    weights = np.zeros((6, len(seen.sigmas)))
    weights[DIAGONAL] = 1 / seen.sigmas
    with np.errstate(all="ignore"):  # a track without a solution is found out at the end
        state = _descended(state, pixels, weights, starts, lens, views)
        if seen.covariances is not None and seen.covariances.any():
            _, _, q = _projected(state, pixels, lens, views)
            weights = _whitening(seen, q, state[2, views.tracks], lens, views.stereo)
            state = _descended(state, pixels, weights, starts, lens, views)
        error, jacobian, q = _projected(state, pixels, lens, views)
        error = times(weights, error)
        factor, _ = _normal(times(weights, jacobian), error, starts)
        chi2, sigma = np.add.reduceat((error**2).sum(axis=0), starts), 1 / factor[5]
        inverse, ahead = state[2], np.minimum.reduceat(q[2], starts) > NEAR
        good = (inverse > 0) & ahead & np.isfinite(sigma) & np.isfinite(chi2)
        rays = np.column_stack([state[0], state[1], np.ones(len(starts))]) / inverse[:, None]
        points = (seen.poses[starts, :3, :3] @ rays[:, :, None])[:, :, 0] + seen.poses[starts, :3, 3]
        share = np.where(good, sigma / inverse, np.inf)
    return Points(points, share, chi2, np.add.reduceat(2.0 + views.stereo, starts) - 3)


def _descended(state: Array, pixels: Array, weights: Array, starts: Rows, lens: Lens, views: _Views) -> Array:
    for _ in range(STEPS):
        error, jacobian, _ = _projected(state, pixels, lens, views)
        factor, gradient = _normal(times(weights, jacobian), times(weights, error), starts)
        lower = inverse_factor(factor)
        step = transposed_times(lower, times(lower, gradient))
        step = np.where(np.isfinite(step), step, 0.0)
        state = state + step
        if np.abs(step).max() < SETTLED:
            break
    return state


def images(points: Array, poses: Array, lens: Lens) -> tuple[Array, Array]:
    """(N, 3) u, v, and u in the right camera, of (N, 3) points seen from (N, 4, 4) map_T_camera; (N, 3) the points in the camera."""
    local = _local(points, poses)
    with np.errstate(all="ignore"):
        return pixels_of(ratios(local.T, lens.baseline), lens).T, local


def covariances(points: Array, seen: Sightings, lens: Lens) -> Array:
    """(T, 3, 3) in the map, of (T, 3) points by their sightings alone, from cameras that stand where they stand."""
    local = _local(points[seen.tracks], seen.poses).T.copy()
    turns = np.ascontiguousarray(seen.poses[:, :3, :3].transpose(2, 1, 0))
    with np.errstate(all="ignore"):
        by_point = of_image(ratios(local, lens.baseline), local[2], turns, lens) / seen.sigmas
    by_point = np.nan_to_num(by_point)
    by_point[2][:, np.isnan(seen.pixels[:, 2])] = 0.0
    by_point = by_point.swapaxes(0, 1)
    information = np.add.reduceat(products(by_point, by_point), seen.starts, axis=1)
    information[DIAGONAL] += 1e-9 * information[DIAGONAL].sum(axis=0) + 1e-12
    return symmetric_inverse(information)


def _local(points: Array, poses: Array) -> Array:
    return np.asarray((points - poses[:, :3, 3])[:, None, :] @ poses[:, :3, :3])[:, 0]


def ratios(local: Array, baseline: Array | float) -> Array:
    """(3, N) x / z and y / z in the left camera, x / z in the right one, of (3, N) points in the left one; baseline in their scale."""
    x, y, z = local
    return np.asarray(np.array([x, y, x - baseline]) / z)


def pixels_of(ratios: Array, lens: Lens) -> Array:
    """(3, N) u, v, right u."""
    return np.asarray(ratios * _focal(lens) + np.array([[lens.cx], [lens.cy], [lens.cx]]))


def _focal(lens: Lens) -> Array:
    return np.array([[lens.fx], [lens.fy], [lens.fx]])


def of_image(ratios: Array, depths: Array, moves: Array, lens: Lens) -> Array:
    """(3, K, N) derivative of u, v, right u by K parameters. ratios: (3, N) of points at depths (N,); moves: (3, K, N), or (3, K, 1)
    where they are those of all, how these points move with the parameters.
    """
    scale = (_focal(lens) / depths)[:, None]
    return np.asarray(scale * (moves[[0, 1, 0]] - ratios[:, None] * moves[2]))


def by_tangent(local: Array, scale: Array | float = 1.0) -> Array:
    """(3, 6, N) how points in the camera (3, N) move with the camera's tangent, rotation first. scale: that of the points."""
    x, y, z = local
    moves = np.zeros((3, 6, local.shape[1]))
    moves[1, 0], moves[2, 1], moves[0, 2] = z, x, y
    moves[2, 0], moves[0, 1], moves[1, 2] = -y, -z, -x
    moves[0, 3] = moves[1, 4] = moves[2, 5] = -scale
    return moves


def _views(seen: Sightings) -> _Views:
    tracks = seen.tracks
    first = seen.poses[seen.starts][tracks]
    back = np.swapaxes(seen.poses[:, :3, :3], 1, 2)
    turns = np.ascontiguousarray((back @ first[:, :3, :3]).transpose(1, 2, 0))
    shifts = np.ascontiguousarray((back @ (first[:, :3, 3] - seen.poses[:, :3, 3])[:, :, None])[:, :, 0].T)
    return _Views(
        np.stack([turns[:, 0], turns[:, 1], shifts], axis=1), turns[:, 2].copy(), tracks, seen.stereo
    )


def _linear(pixels: Array, starts: Rows, lens: Lens, views: _Views) -> Array:
    """(3, T): the direction as seen first, the inverse distance by least squares from all other images."""
    image = (pixels - np.array([[lens.cx], [lens.cy], [lens.cx]])) / _focal(lens)
    ray = image[:2, starts]
    a, b = ray[:, views.tracks]
    q = views.moves[:, 0] * a + views.moves[:, 1] * b + views.axis
    shifts = views.moves[:, 2]
    gain = shifts[[0, 1, 0]] - image * shifts[2]
    gain[2] -= lens.baseline
    wanted = image * q[2] - q[[0, 1, 0]]
    gain[2, ~views.stereo] = wanted[2, ~views.stereo] = 0.0
    square, product = np.add.reduceat(
        np.stack([(gain**2).sum(axis=0), (gain * wanted).sum(axis=0)]), starts, axis=1
    )
    inverse = product / np.maximum(square, np.finfo(float).tiny)
    return np.stack([ray[0], ray[1], np.maximum(inverse, 0.0)])


def _projected(state: Array, pixels: Array, lens: Lens, views: _Views) -> tuple[Array, Array, Array]:
    """Errors (3, N), measured minus expected; the image's Jacobian (3, 3, N) by the state; the point in the camera over its first
    distance (3, N).
    """
    state, mono = state[:, views.tracks], ~views.stereo
    q = (views.moves * state).sum(axis=1) + views.axis
    shown = ratios(q, lens.baseline * state[2])
    error, jacobian = pixels - pixels_of(shown, lens), of_image(shown, q[2], views.moves, lens)
    jacobian[2, 2] -= lens.fx * lens.baseline / q[2]
    error[2, mono] = 0.0
    jacobian[2][:, mono] = 0.0
    return error, jacobian, q


def _whitening(seen: Sightings, q: Array, inverse: Array, lens: Lens, stereo: NDArray[np.bool_]) -> Array:
    """(6, N) of images whose cameras stand where they stand by their covariances. inverse: (N,) of the distance, the scale of q (3, N)."""
    assert seen.covariances is not None
    moves = by_tangent(q, inverse)
    by_pose = of_image(ratios(q, lens.baseline * inverse), q[2], moves, lens)
    by_pose[2][:, ~stereo] = 0.0
    each = by_pose.transpose(2, 0, 1)
    return whitening(six_of(each @ seen.covariances @ each.transpose(0, 2, 1)), seen.sigmas)


def whitening(noise: Array, sigmas: Array) -> Array:
    """(6, N) lower W with W^T W the inverse of (6, N) noise plus that of the pixels themselves, (N,). What is not finite of the
    noise is left out, and what rounding has made of directions without noise.
    """
    noise = np.where(np.isfinite(noise), noise, 0.0)
    noise[DIAGONAL] += sigmas**2
    found = inverse_factor(cholesky(noise))
    bad = ~np.isfinite(found).all(axis=0)
    if bad.any():
        values, vectors = np.linalg.eigh(full(noise[:, bad]))
        values = np.maximum(values, (sigmas[bad] ** 2)[:, None])
        mended = (vectors * values[:, None]) @ np.swapaxes(vectors, 1, 2)
        found[:, bad] = inverse_factor(cholesky(six_of(mended)))
    return found


def _normal(jacobian: Array, error: Array, starts: Rows) -> tuple[Array, Array]:
    """The factor (6, T) of each track's information, and its gradient (3, T), from whitened rows."""
    columns = jacobian.swapaxes(0, 1)
    sums = np.concatenate([products(columns, columns), (columns * error).sum(axis=1)])
    sums = np.add.reduceat(sums, starts, axis=1)
    information, gradient = sums[:6], sums[6:]
    information[DIAGONAL] += 1e-12 * (1 + information[DIAGONAL].sum(axis=0))
    return cholesky(information), gradient
