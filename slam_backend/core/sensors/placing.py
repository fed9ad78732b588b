"""Where a landmark is that has been seen only by range or by bearing: delayed initialization.

Sightings wait until they fix a place. The place is the least robust cost over all of them, the robot's poses taken as they are:
Levenberg-Marquardt from many starts at once, on a grid of directions and radii for ranges (two circles cross twice), and from the
point nearest to all lines of sight for bearings. It is believed when
    the next other place costs AMBIGUOUS more: of two mirror images the robot must have left the line between them,
    no direction of it is less certain than LOOSE of the distance: enough parallax,
    and the sightings agree with it: half of them to within CONTRADICTION standard deviations.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..graph import Pose
from ..measurement import Array

FEWEST = 2  # sightings more than a point has axes
GROWTH = 1.25  # by which the number of sightings grows between two attempts: their cost stays linear
AMBIGUOUS = 8.0  # chi-square by which the second best place must be worse
LOOSE = 0.1  # of the distance: the largest standard deviation of a place that serves as first guess
CONTRADICTION = 3.0  # standard deviations
WIDTH = 2.3849  # of the Cauchy kernel, in standard deviations
PER_KEYFRAME = 3  # sightings from one place that count: their errors are alike
MOST = 200  # sightings that count at all, evenly chosen
RADII = (0.5, 1.0, 2.0)  # of the median range, around the middle of the way
ROUNDS = 40
NEAR = 1e-6  # m


class Sighting(NamedTuple):
    """Of one landmark. sensor: its pose in the map, told from this keyframe. distance in m, None where it was not seen."""

    sensor: Pose
    keyframe: int
    distance: float | None
    sigma_distance: float
    direction: Array | None  # unit vector in the frame of the sensor
    sigma_direction: float


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """What the sightings say. point: None while they do not fix one; why: then, in words.

    margin: chi-square by which the next other place is worse; None where there is none. sigma: m, in the least certain
    direction; None where nothing is known of one.
    """

    point: Array | None
    why: str
    margin: float | None
    sigma: float | None
    others: tuple[Array, ...] = ()


def is_due(before: int, now: int, axes: int) -> bool:
    """Whether so many sightings are worth another attempt: at fixed numbers, whatever window they come in."""
    if now < axes + FEWEST:
        return False
    return before < axes + FEWEST or int(np.log(now) / np.log(GROWTH)) > int(np.log(before) / np.log(GROWTH))


def place(sightings: list[Sighting]) -> Place:
    rays = _Rays(_thinned(sightings))
    points, costs = rays.descended(rays.starts())
    order = np.argsort(costs, kind="stable")
    best, cost = points[order[0]], float(costs[order[0]])
    information, residuals = rays.information(best)
    scale = max(
        1.0, cost / len(rays.positions)
    )  # noise that is understated must not decide between two places
    reach = float(np.median(np.linalg.norm(best - rays.positions, axis=1)))
    spread = np.linalg.eigvalsh(information)[0]
    sigma = float(np.sqrt(scale / spread)) if spread > 0 else np.inf
    others = [
        k for k in order[1:] if np.linalg.norm(points[k] - best) > max(3 * min(sigma, reach), 0.05 * reach)
    ]
    margin = (float(costs[others[0]]) - cost) / scale if others else np.inf
    second = (points[others[0]],) if others and margin < AMBIGUOUS else ()
    why = ""
    if not sigma <= LOOSE * reach:
        within = f"to {sigma:.2g} m" if sigma < reach else "not at all"
        why = f"its place is known {within}, at {reach:.3g} m: too little parallax"
    elif second:
        why = f"two places fit: {_told(best)} and {_told(second[0])}"
    elif np.median(residuals) > CONTRADICTION:
        why = f"its sightings contradict each other: half of them by {np.median(residuals):.1f} standard deviations"
    return Place(
        None if why else best,
        why,
        margin if others else None,
        sigma if sigma < reach else None,
        (best, *second),
    )


def _thinned(sightings: list[Sighting]) -> list[Sighting]:
    """At most PER_KEYFRAME of each keyframe, and MOST in all: a robot that stands still learns nothing new."""
    counts: dict[int, int] = {}
    kept = []
    for each in sightings:
        counts[each.keyframe] = counts.get(each.keyframe, 0) + 1
        if counts[each.keyframe] <= PER_KEYFRAME:
            kept.append(each)
    rows = np.unique(np.linspace(0, len(kept) - 1, min(len(kept), MOST)).round().astype(int))
    return [kept[row] for row in rows]


class _Rays:
    """The sightings in columns, in the map."""

    def __init__(self, sightings: list[Sighting]) -> None:
        poses = [each.sensor for each in sightings]
        self.positions = np.array([pose.translation() for pose in poses])
        self.ranged = np.array([each.distance is not None for each in sightings])
        self.aimed = np.array([each.direction is not None for each in sightings])
        self.distances = np.array([each.distance for each in sightings if each.distance is not None])
        aims = [
            p.rotation().matrix() @ s.direction
            for p, s in zip(poses, sightings, strict=True)
            if s.direction is not None
        ]
        self.directions = np.array(aims).reshape(-1, self.axes)
        self._sigma_distance = np.array([s.sigma_distance for s in sightings if s.distance is not None])
        self._sigma_direction = np.array([s.sigma_direction for s in sightings if s.direction is not None])

    @property
    def axes(self) -> int:
        return int(self.positions.shape[1])

    def starts(self) -> Array:
        """(M, d) points from which to look for the minima of the cost."""
        found = []
        if self.ranged.any():
            compass = _compass(self.axes)
            middle, reach = self.positions[self.ranged].mean(axis=0), float(np.median(self.distances))
            found += [middle + radius * reach * compass for radius in RADII]
        if self.aimed.any():
            found.append(self._crossing()[None])
        return np.concatenate(found)

    def _crossing(self) -> Array:
        """The point nearest to all lines of sight."""
        across = np.eye(self.axes) - self.directions[:, :, None] * self.directions[:, None, :]
        vector = (across @ self.positions[self.aimed][:, :, None]).sum(axis=0)[:, 0]
        return np.asarray(np.linalg.lstsq(across.sum(axis=0), vector, rcond=None)[0])

    def descended(self, points: Array) -> tuple[Array, Array]:
        """(M, d) minima, each reached from its start, and their costs (chi-square under the kernel)."""
        costs, damping = self._costs(points), np.full(len(points), 1e-3)
        for _ in range(ROUNDS):
            residuals, jacobians = self._linear(points)
            weights = 1 / (1 + (np.linalg.norm(residuals, axis=2) / WIDTH) ** 2)
            weighted = jacobians * weights[:, :, None, None]
            hessian = np.einsum("mnij,mnik->mjk", weighted, jacobians)
            gradient = np.einsum("mnij,mni->mj", weighted, residuals)
            diagonal = np.einsum("mjj->mj", hessian).max(axis=1)[:, None, None] * np.eye(self.axes)
            step = np.linalg.solve(hessian + damping[:, None, None] * diagonal, gradient[:, :, None])[:, :, 0]
            trial = points - step
            tried = self._costs(trial)
            better = tried <= costs
            points, costs = np.where(better[:, None], trial, points), np.where(better, tried, costs)
            damping = np.clip(np.where(better, damping / 5, damping * 5), 1e-9, 1e6)
        return points, costs

    def information(self, point: Array) -> tuple[Array, Array]:
        """(d, d) of a place, outliers weighed down, and (N,) how far each sighting is off, in standard deviations."""
        residuals, jacobians = self._linear(point[None])
        far = np.linalg.norm(residuals[0], axis=1)
        weights = 1 / (1 + (far / WIDTH) ** 2)
        return np.einsum("n,nij,nik->jk", weights, jacobians[0], jacobians[0]), far

    def _costs(self, points: Array) -> Array:
        square = (self._linear(points)[0] ** 2).sum(axis=2)
        return np.asarray((WIDTH**2 * np.log1p(square / WIDTH**2)).sum(axis=1))

    def _linear(self, points: Array) -> tuple[Array, Array]:
        """(M, K, d) whitened residuals, one row per range and per bearing, and their (M, K, d, d) derivatives by the point.

        A range has one residual and zeros beside it; a bearing the chord between two unit vectors, which is largest behind.
        """
        offsets = points[:, None, :] - self.positions
        reach = np.maximum(np.linalg.norm(offsets, axis=2), NEAR)
        along = offsets / reach[:, :, None]
        residuals, jacobians = [], []
        if self.ranged.any():
            residual = np.zeros((len(points), len(self.distances), self.axes))
            jacobian = np.zeros((*residual.shape, self.axes))
            residual[:, :, 0] = (reach[:, self.ranged] - self.distances) / self._sigma_distance
            jacobian[:, :, 0] = along[:, self.ranged] / self._sigma_distance[:, None]
            residuals.append(residual)
            jacobians.append(jacobian)
        if self.aimed.any():
            seen = along[:, self.aimed]
            across = np.eye(self.axes) - seen[..., :, None] * seen[..., None, :]
            residuals.append((seen - self.directions) / self._sigma_direction[:, None])
            jacobians.append(across / (reach[:, self.aimed] * self._sigma_direction)[..., None, None])
        return np.concatenate(residuals, axis=1), np.concatenate(jacobians, axis=1)


def _compass(axes: int) -> Array:
    """(12, axes) directions, evenly spread: of a clock, or of the corners of an icosahedron."""
    if axes == 2:
        angles = np.arange(12) * np.pi / 6
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)
    golden = (1 + np.sqrt(5)) / 2
    corners = [(0.0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    turned = [np.roll(corner, k) for corner in corners for k in range(3)]
    return np.asarray(np.array(turned) / np.hypot(1, golden))


def _told(point: Array) -> str:
    return "(" + ", ".join(f"{axis:.2f}" for axis in point) + ")"
