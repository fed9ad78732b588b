"""An estimate that another solver found for the factors of this one."""

from collections.abc import Sequence
from typing import Any

import gtsam

from .graph import Estimate, Pose
from .measurement import Array
from .space import Space
from .variables import value_in


class Adopted:
    """Values from outside, covariances from the solver that holds the factors. Implements graph.Estimate."""

    def __init__(self, values: gtsam.Values, space: Space, solver: Estimate) -> None:
        self._values, self._space, self._solver = values, space, solver

    def pose(self, key: int) -> Pose:
        return self._space.pose_in(self._values, key)

    def point(self, key: int) -> Array:
        return self._space.point_in(self._values, key)

    def value(self, key: int) -> Any:
        return value_in(self._space, self._values, key)

    def knows(self, key: int) -> bool:
        return bool(self._values.exists(key))

    def values(self) -> gtsam.Values:
        return gtsam.Values(self._values)

    def covariance(self, keys: Sequence[int]) -> Array:
        return self._solver.covariance(keys)
