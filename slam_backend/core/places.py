"""Where sightings put a landmark: one by one, and whether many of them lie at one place or at two."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

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


@dataclass(frozen=True, slots=True, eq=False)
class Parted:
    """Sightings of one landmark that lie at two places. first: (N,) which of them are at the place that was seen first.

    apart: m between the two; spreads: m of either around its median; limit: m that noise explains. since: the stamp from which on all
    are at the second place; None where they are seen in turn.
    """

    places: Places
    first: NDArray[np.bool_]
    apart: float
    limit: float
    since: int | None

    @property
    def fewest(self) -> int:
        """Sightings at the place that has fewer of them."""
        return int(min(self.first.sum(), (~self.first).sum()))

    @property
    def spreads(self) -> tuple[float, float]:
        points = self.places.points
        return spread(points[self.first]), spread(points[~self.first])


def seen_at(factor: Factor) -> Array:
    """The point that a sighting states, in the frame of its pose."""
    seen = factor.factor.measured()
    if isinstance(factor.factor, TAGS):
        return np.asarray(seen.translation())
    direction = seen.bearing()
    ahead = direction.point3() if hasattr(direction, "point3") else np.array([direction.c(), direction.s()])
    return np.asarray(ahead * seen.range())


def place_of(factor: Factor, estimate: Estimate) -> Array:
    """In the map, from the pose of the sighting as it is believed now."""
    return np.asarray(estimate.pose(factor.keys[0]).transformFrom(seen_at(factor)))


def misfit(factor: Factor, landmark: Any, estimate: Estimate, space: Space) -> float:
    """Chi-square of a sighting, if its landmark is there; of a tag that of its position alone."""
    values = gtsam.Values()
    values.insert(factor.keys[0], estimate.value(factor.keys[0]))
    values.insert(factor.keys[1], landmark)
    noise: Any = without_kernel(factor.factor.noiseModel())
    if isinstance(factor.factor, TAGS):
        place = space.translation
        off = factor.factor.unwhitenedError(values)[place]
        return float(off @ np.linalg.solve(noise.covariance()[place, place], off))
    white = noise.whiten(factor.factor.unwhitenedError(values))
    return float(white @ white)


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


def parted(places: Places, limit: float) -> Parted | None:
    """The two places at which sightings lie, one after the other or in turn; None if they do not. limit: m that noise explains."""
    points = places.points
    then = parted_in_time(points)
    if then is not None and (apart := apart_by(points[:then], points[then:], limit)):
        return Parted(places, np.arange(len(points)) < then, apart, limit, places.factors[then].stamp)
    one = halves(points)
    if apart := apart_by(points[one], points[~one], limit):
        return Parted(places, one if one[0] else ~one, apart, limit, None)
    return None


def parted_in_time(points: Array) -> int | None:
    """Where a sequence is best cut into two, each around its own place; None if it is too short for that."""
    cuts: Iterable[int] = range(2, len(points) - 1)
    scatter = {cut: _scatter(points[:cut]) + _scatter(points[cut:]) for cut in cuts}
    return min(scatter, key=lambda cut: (scatter[cut], cut), default=None)


def _scatter(points: Array) -> float:
    return float(np.linalg.norm(points - np.median(points, axis=0), axis=1).sum())


def halves(points: Array) -> NDArray[np.bool_]:
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
