"""Where sightings put a landmark: one by one, and whether many of them lie at one place or at two."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import sqrt

import gtsam
import numpy as np

from .graph import Estimate, Factor
from .measurement import Array
from .robust.kernels import without_kernel
from .space import Space

TAGS = (gtsam.BetweenFactorPose2, gtsam.BetweenFactorPose3)


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where the sightings of one landmark put it, in the order of their stamps; sigma (m): of a single one."""

    factors: Sequence[Factor]
    points: Array
    sigma: float


def place_of(factor: Factor, estimate: Estimate) -> Array:
    """In the map, from the pose of the sighting as it is believed now."""
    seen = factor.factor.measured()
    if isinstance(factor.factor, TAGS):
        return np.asarray(estimate.pose(factor.keys[0]).transformFrom(seen.translation()))
    direction = seen.bearing()
    ahead = direction.point3() if hasattr(direction, "point3") else np.array([direction.c(), direction.s()])
    return np.asarray(estimate.pose(factor.keys[0]).transformFrom(ahead * seen.range()))


def sigma_of(factor: Factor, space: Space) -> float:
    """m, of the position that a sighting states: its bearing acts across, at its range."""
    variances = without_kernel(factor.factor.noiseModel()).covariance().diagonal().tolist()
    if isinstance(factor.factor, TAGS):
        return sqrt(max(variances[space.translation]))
    return sqrt(variances[-1] + max(variances[:-1]) * factor.factor.measured().range() ** 2)


def spread(points: Array) -> float:
    """The distance from the median within which nine of ten lie: a few strays are noise, a second place is not."""
    return float(np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.9))


def apart_by(one: Array, other: Array, limit: float) -> float:
    """How far apart two places are; 0 if they are none: wider than the limit, or than a fourth of the way between them."""
    if not len(one) or not len(other):
        return 0.0
    apart = float(np.linalg.norm(np.median(one, axis=0) - np.median(other, axis=0)))
    return apart if max(spread(one), spread(other)) <= min(limit, apart / 4) else 0.0


def parted_in_time(points: Array) -> int | None:
    """Where a sequence is best cut into two, each around its own place; None if it is too short for that."""
    cuts: Iterable[int] = range(2, len(points) - 1)
    scatter = {cut: _scatter(points[:cut]) + _scatter(points[cut:]) for cut in cuts}
    return min(scatter, key=lambda cut: (scatter[cut], cut), default=None)


def _scatter(points: Array) -> float:
    return float(np.linalg.norm(points - np.median(points, axis=0), axis=1).sum())


def halves(points: Array) -> np.ndarray:
    """(N,) which of two clusters: k-means (Lloyd, 1982) from the two points that lie farthest apart."""
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2)
    a, b = np.unravel_index(int(np.argmax(gaps)), gaps.shape)
    centres = points[[a, b]]
    for _ in range(10):
        first = np.linalg.norm(points - centres[0], axis=1) <= np.linalg.norm(points - centres[1], axis=1)
        if first.all() or not first.any():
            break
        centres = np.array([points[first].mean(axis=0), points[~first].mean(axis=0)])
    return np.asarray(first)
