"""What floats: the parts of a graph that nothing fixes in space, and the variables that nothing touches."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..errors import SolverFailure
from ..graph import HOLDING, Factor, is_pose
from ..space import SPACES, Space

GAUGE_SIGMA = 1e-3  # m and rad; any value gives the same optimum, this one is no stranger among usual noise
FIXING = HOLDING | {"pose"}  # kinds of factors that hold a part in space

Labels = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The variables of a graph and its connected parts.

    keys: (N,) sorted, of all that the factors touch. part: (N,) the row of the first variable of the same part.
    idle: variables of the start that no factor touches; they stay where they are.
    """

    keys: NDArray[np.uint64]
    part: Labels
    idle: tuple[int, ...]

    def rows(self, keys: Sequence[int]) -> Labels:
        return np.searchsorted(self.keys, np.array(keys, dtype=np.uint64)).astype(np.int64)

    def touched(self, values: gtsam.Values) -> gtsam.Values:
        """Without those that no factor touches: an optimizer takes no others."""
        kept = gtsam.Values(values)
        for key in self.idle:
            kept.erase(key)
        return kept

    @property
    def roots(self) -> list[int]:
        """The first variable of each part."""
        return [int(key) for key in self.keys[np.unique(self.part)]]

    def sizes(self) -> list[int]:
        return [int(count) for count in np.unique(self.part, return_counts=True)[1]]


def layout(factors: Sequence[Factor], start: gtsam.Values | None = None) -> Layout:
    touched = np.array([key for factor in factors for key in factor.keys], dtype=np.uint64)
    keys, rows = np.unique(touched, return_inverse=True)
    sizes = np.array([len(factor.keys) for factor in factors], dtype=np.int64)
    first = np.repeat(np.cumsum(sizes) - sizes, sizes)  # place of each factor's first key in `touched`
    part = connected(len(keys), rows[first], rows)
    idle = np.setdiff1d(np.array(start.keys(), dtype=np.uint64), keys) if start is not None else ()
    return Layout(keys, part, tuple(int(key) for key in idle))


def space_of(factors: Iterable[Factor]) -> Space:
    """The space whose poses the factors are about; SolverFailure when there are none."""
    for factor in factors:
        for space in SPACES.values():
            if isinstance(factor.factor, (space.between, space.prior)):
                return space
    raise SolverFailure("there are no edges between poses: nothing to solve", ())


def gauges(factors: Sequence[Factor], found: Layout, start: gtsam.Values, space: Space) -> tuple[Factor, ...]:
    """A prior on the first pose of each part that nothing fixes, at its start."""
    fixed = {int(found.part[row]) for row in found.rows([f.keys[0] for f in factors if f.kind in FIXING])}
    noise = gtsam.noiseModel.Isotropic.Sigma(space.dimension, GAUGE_SIGMA)
    made = []
    for row, root in zip(np.unique(found.part).tolist(), found.roots, strict=True):
        if row not in fixed:
            key = root if is_pose(root) else _first_pose(found, row)
            prior = space.prior(key, space.pose_in(start, key), noise)
            made.append(Factor(f"gauge/{key}", "gauge", prior, (key,), 0))
    return tuple(made)


def _first_pose(found: Layout, row: int) -> int:
    return next(int(key) for key in found.keys[found.part == row] if is_pose(int(key)))


def connected(count: int, i: Labels, j: Labels) -> Labels:
    """(count,) the smallest member of each one's connected part: hook the larger root to the smaller, then jump."""
    label = np.arange(count, dtype=np.int64)
    while True:
        low, high = np.minimum(label[i], label[j]), np.maximum(label[i], label[j])
        if (low == high).all():
            return label
        np.minimum.at(label, high, low)
        while (jumped := label[label] != label).any():
            label[jumped] = label[label[jumped]]
