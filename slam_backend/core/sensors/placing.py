"""Where a landmark is that has been seen only by range or by bearing: delayed initialization.

Sightings wait until they fix a place. Places are looked for as the robot's poses are: the least robust costs over all sightings, by
Levenberg-Marquardt from many starts at once, on a grid of directions and radii for ranges (two circles cross twice), and from the
point nearest to all lines of sight for bearings. Each minimum is then judged with the poses as uncertain as the odometry between
them (drift.py): what lifts a robot off a plane, and tells above from below, may be nothing but drift. The best is believed when
    the next other place costs AMBIGUOUS more: of two mirror images the robot must have left the line between them,
    no direction of it is less certain than LOOSE of the distance: enough parallax,
    and the sightings agree with it: half of them to within CONTRADICTION standard deviations.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..graph import Pose
from ..measurement import Array
from .drift import Drift

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
JUDGED = 6  # minima at most
AGAIN = 10  # rounds of a minimum under the drift
APART = 0.05  # of the distance: what is nearer is the same minimum
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


class Minimum(NamedTuple):
    """Of the cost. information: (d, d) of the point. residuals: (N,) how far each sighting is off, in standard deviations.
    gradient: (d,) of the cost, halved.
    """

    point: Array
    cost: float
    information: Array
    residuals: Array
    gradient: Array


def place(sightings: list[Sighting], drift: Callable[[Sequence[int]], Drift] | None = None) -> Place:
    """drift: of the way through these keyframes; none: their poses are exact."""
    kept = _thinned(sightings)
    keyframes = list(dict.fromkeys(each.keyframe for each in kept))
    rays = _Rays(kept, keyframes)
    way = drift(keyframes) if drift else Drift((), ())
    found = sorted((rays.judged(point, way) for point in rays.minima()), key=lambda each: each.cost)
    best, cost, information, residuals, _ = found[0]
    scale = max(
        1.0, cost / len(rays.positions)
    )  # noise that is understated must not decide between two places
    reach = float(np.median(np.linalg.norm(best - rays.positions, axis=1)))
    spread = np.linalg.eigvalsh(information)[0]
    sigma = float(np.sqrt(scale / spread)) if spread > 0 else np.inf
    near, image = min(sigma, reach), rays.fit(rays.mirrored(best), way)
    rivals = [*((each, 3 * near) for each in found[1:]), (image, near)]
    others = [each for each, limit in rivals if np.linalg.norm(each.point - best) > max(limit, APART * reach)]
    others.sort(key=lambda each: each.cost)
    margin = (others[0].cost - cost) / scale if others else np.inf
    second = (others[0].point,) if others and margin < AMBIGUOUS else ()
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

    def __init__(self, sightings: list[Sighting], keyframes: Sequence[int]) -> None:
        """keyframes: in the order in which a Drift has them."""
        poses = [each.sensor for each in sightings]
        numbers = {key: n for n, key in enumerate(keyframes)}
        self._at = np.array([numbers[each.keyframe] for each in sightings])
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

    def minima(self) -> list[Array]:
        """The lowest first."""
        points, costs = self.descended(self.starts())
        order = np.argsort(costs, kind="stable")
        reach = float(np.median(np.linalg.norm(points[order[0]] - self.positions, axis=1)))
        found: list[Array] = []
        for point in points[order]:
            if len(found) < JUDGED and all(np.linalg.norm(point - each) > APART * reach for each in found):
                found.append(point)
        return found

    def judged(self, point: Array, drift: Drift) -> Minimum:
        """The minimum near a point, with the poses as uncertain as the drift has them; outliers are weighed down."""
        factor = np.asarray(np.linalg.cholesky(self._noise(point, drift)))
        best = self._under(point, factor)
        for _ in range(AGAIN if drift.steps else 0):
            step, *_ = np.linalg.lstsq(best.information, best.gradient, rcond=None)
            trial = self._under(best.point - step, factor)
            if not trial.cost < best.cost:
                break
            best = trial
        return best

    def fit(self, point: Array, drift: Drift) -> Minimum:
        """How well a point fits that need be no minimum."""
        return self._under(point, np.asarray(np.linalg.cholesky(self._noise(point, drift))))

    def mirrored(self, point: Array) -> Array:
        """In the line or plane that the way of the sensor is nearest to. Where little tells the two sides apart, there is but one
        minimum at times, and a wrong one; what it costs to be on the other side tells.
        """
        middle = self.positions.mean(axis=0)
        normal = np.linalg.svd(self.positions - middle)[2][-1]
        return np.asarray(point - 2 * ((point - middle) @ normal) * normal)

    def _under(self, point: Array, factor: Array) -> Minimum:
        residuals, jacobians = (each[0] for each in self._linear(point[None]))
        rows = self._rows()
        whole = np.zeros(rows.shape)
        whole[rows] = np.linalg.solve(factor, residuals[rows])
        slopes = np.zeros(jacobians.shape)
        slopes[rows] = np.linalg.solve(factor, jacobians[rows])
        far = np.linalg.norm(whole, axis=1)
        weights = 1 / (1 + (far / WIDTH) ** 2)
        cost = float((WIDTH**2 * np.log1p(far**2 / WIDTH**2)).sum())
        information = np.einsum("n,nij,nik->jk", weights, slopes, slopes)
        return Minimum(point, cost, information, far, np.einsum("n,nij,ni->j", weights, slopes, whole))

    def _rows(self) -> NDArray[np.bool_]:
        """(K, d) the residuals that say something: one of a range, all of a bearing."""
        rows = np.ones((len(self.distances) + len(self.directions), self.axes), dtype=bool)
        rows[: len(self.distances), 1:] = False
        return rows

    def _noise(self, point: Array, drift: Drift) -> Array:
        """(M, M) covariance of those residuals: their own, and what the drift adds."""
        rows = self._rows()
        order = np.concatenate([np.flatnonzero(self.ranged), np.flatnonzero(self.aimed)])
        owner, axis = np.nonzero(rows)
        by_place = -self._linear(point[None])[1][0][rows]
        turn = np.zeros((len(owner), 1 if self.axes == 2 else 3))
        aimed = owner >= len(self.distances)
        ray = owner[aimed] - len(self.distances)
        ahead = self.directions[ray] / self._sigma_direction[ray, None]
        if self.axes == 2:
            turn[aimed, 0] = np.where(axis[aimed] == 0, ahead[:, 1], -ahead[:, 0])
        else:
            turn[aimed] = -np.cross(ahead, np.eye(3)[axis[aimed]])
        sightings = order[owner]
        drifted = drift.covariance(self._at[sightings], self.positions[sightings], by_place, turn)
        return np.asarray(np.eye(len(owner)) + drifted)

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
