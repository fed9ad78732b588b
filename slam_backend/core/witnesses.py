"""Whether a landmark stands at two places, or the robot was elsewhere than it is believed to have been.

A pose that is off, before a loop closes or after the wheels have slipped, draws what is seen from it at a wrong place, and what is new there fits
it. So two places need a witness that does not rest on that:

    the ways from sightings of the one to the next of the other, with the odometry as uncertain as the gate for loops has it: one way over a
    loop, or two short ones, there and back,
    two other landmarks that were known before the second place was seen, and fit where they are seen beside it,
    or something absolute.
"""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from .graph import Factor, Motion
from .measurement import SECOND
from .places import Parted, seen_at
from .robust.chi2 import chi2_quantile
from .robust.paths import Paths
from .sensors.landmark import moved

CERTAIN = 1 - 1e-6  # probability of chi-square beyond which motion says that two sightings are of two places
SHORT = 10.0  # m of motion on that way; on a longer one the wheels may slip by more than they ever say
ENOUGH = 2  # ways, or other landmarks
NEAR = 10 * SECOND  # before and after
SURE = 3.0  # standard deviations by which the two places must lie farther apart
ABSOLUTE = frozenset({"gnss", "pose"})  # kinds of factors that hold a pose by themselves


def are_two(two: Parted, paths: Paths, factors: Iterable[Factor], fits: Callable[[Factor], bool]) -> bool:
    """factors: of the graph. fits: whether a sighting does. Costs time in proportion to the graph where motion alone cannot tell."""
    seen = two.places.factors
    turns = [n for n in range(1, len(seen)) if two.first[n - 1] != two.first[n]]
    ways = sum(_by_motion(seen[n - 1], seen[n], two, paths) for n in turns)
    return ways >= ENOUGH or _by_others(two, paths, factors, fits)


def _by_motion(one: Factor, other: Factor, two: Parted, paths: Paths) -> int:
    """How much a way says: nothing, as much as one, or, over a loop, as much as is enough."""
    path, space = paths.cheapest((one.keys[0], other.keys[0])), paths.space
    if path is None or path.meters > SHORT:
        return 0
    own = np.eye(space.point_dimension) * two.places.sigma**2
    motion = Motion(path.pose, path.covariance(paths.scale))
    point, noise = moved(seen_at(other), own, space.identity, motion)
    gap = point - seen_at(one)
    if float(gap @ np.linalg.solve(noise + own, gap)) <= chi2_quantile(CERTAIN, len(gap)):
        return 0
    return ENOUGH if path.via else 1


def _by_others(two: Parted, paths: Paths, factors: Iterable[Factor], fits: Callable[[Factor], bool]) -> bool:
    seen = two.places.factors
    there = [factor for factor, first in zip(seen, two.first, strict=True) if not first]
    known = seen[int(np.argmin(two.first)) - 1].stamp  # of the last sighting before the second place was seen
    before, again = set[int](), set[int]()
    beside: dict[int, bool] = {factor.keys[0]: True for factor in there}
    for factor in factors:
        pose = factor.keys[0]
        if factor.kind in ABSOLUTE and known < factor.stamp <= there[-1].stamp:
            return True
        if factor.kind != "landmark" or factor.keys[1] == seen[0].keys[1]:
            continue
        if factor.stamp <= known:
            before.add(factor.keys[1])
        elif there[0].stamp - NEAR <= factor.stamp <= there[-1].stamp + NEAR:
            if pose not in beside:
                beside[pose] = _is_beside(pose, factor.stamp, there, two, paths)
            if beside[pose] and fits(factor):
                again.add(factor.keys[1])
    return len(before & again) >= ENOUGH


def _is_beside(pose: int, stamp: int, there: Sequence[Factor], two: Parted, paths: Paths) -> bool:
    """Whether from a pose that saw others it is known where the second place is, by motion alone."""
    sighting = min(there, key=lambda factor: abs(factor.stamp - stamp))
    path, space = paths.along(pose, sighting.keys[0]), paths.space
    if path is None:
        return False
    none = np.zeros((space.point_dimension,) * 2)
    motion = Motion(path.pose, path.covariance(paths.scale))
    _, noise = moved(seen_at(sighting), none, space.identity, motion)
    return SURE * float(np.sqrt(np.linalg.eigvalsh(noise)[-1])) <= two.apart
