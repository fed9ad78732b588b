"""Two parts of the graph that see the same landmarks: how they lie to each other, once enough of these are in both.

One tag, whose orientation is known, is enough. Of points, the rigid motion between two sets is that of least squares (Umeyama, PAMI 1991, without scale). One landmark more is asked
for than determine it, so that the two constellations can contradict; the worst is left out while they do.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from .graph import Estimate, Pose, Seen, Wait
from .measurement import Array
from .space import Space

AGREEMENT = (
    0.1  # of the spread of the landmarks: the root mean square that may be left between two constellations
)
FLAT = 0.1  # of the longest axis: the next one that points in space need, or they lie on a line


class Reunion(NamedTuple):
    """shift: `to_T_part`. waits: the sightings that say so."""

    part: int
    to: int
    shift: Pose
    waits: tuple[Wait, ...]


def reunion(
    space: Space, waits: Iterable[Wait], estimate: Estimate, part_of: Callable[[int], int | None]
) -> Reunion | None:
    """The first two parts, in order of waiting, whose common landmarks tell; waits: those for a joint."""
    by_parts: dict[tuple[int, int], dict[int, tuple[Wait, Seen]]] = {}
    for wait in waits:
        if wait.seen is None:
            continue
        part, to = part_of(wait.seen.pose), part_of(wait.seen.landmark)
        if part is None or to is None or part == to:
            continue
        if not isinstance(wait.seen.point, np.ndarray):
            return Reunion(part, to, _carried(wait.seen, estimate), (wait,))
        by_parts.setdefault((part, to), {})[wait.seen.landmark] = (wait, wait.seen)
    for (part, to), found in by_parts.items():
        if len(found) <= space.point_dimension:
            continue
        here = np.array([estimate.pose(s.pose).transformFrom(s.point) for _, s in found.values()])
        there = np.array([estimate.point(s.landmark) for _, s in found.values()])
        fit = _agreed(space, here, there)
        if fit is not None:
            shift, rows = fit
            each = [wait for wait, _ in found.values()]
            return Reunion(part, to, shift, tuple(each[row] for row in rows))
    return None


def _carried(seen: Seen, estimate: Estimate) -> Pose:
    """By which a part moves, so that a tag that it sees lies where the other part has it."""
    here = estimate.pose(seen.pose).compose(seen.point)
    return estimate.pose(seen.landmark).compose(here.inverse())


def _agreed(space: Space, here: Array, there: Array) -> tuple[Pose, Sequence[int]] | None:
    rows = np.arange(len(here))
    while len(rows) > space.point_dimension:
        a, b = here[rows], there[rows]
        spread = np.linalg.svd(b - b.mean(axis=0), compute_uv=False)
        if len(spread) > 2 and spread[1] < FLAT * spread[0]:
            return None
        rotation, translation = _rigid(a, b)
        left = np.linalg.norm(b - (a @ rotation.T + translation), axis=1)
        if np.sqrt(np.mean(left**2)) <= AGREEMENT * spread[0] / np.sqrt(len(rows)):
            return space.rigid(rotation, translation), rows.tolist()
        rows = np.delete(rows, int(np.argmax(left)))
    return None


def _rigid(a: Array, b: Array) -> tuple[Array, Array]:
    """Rotation and translation that bring a (N, d) closest to b."""
    u, _, vt = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    sign = np.ones(a.shape[1])
    sign[-1] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = u @ np.diag(sign) @ vt
    return rotation, b.mean(axis=0) - rotation @ a.mean(axis=0)
