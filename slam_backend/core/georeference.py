"""How the map lies on the earth, with its covariance; or why that is not known yet."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import atan2, sqrt
from typing import Any

import numpy as np

from .errors import SlamError
from .geometry import inverse_of, matrix_of
from .graph import DATUM, EARTH, Estimate, Pose
from .measurement import Array
from .space import Space


@dataclass(frozen=True, slots=True, eq=False)
class Georeference:
    """origin: latitude, longitude (degrees WGS-84), altitude (m) of the frame earth: x east, y north, z up; None before the first fix.

    pose: (7,) map_T_earth, x y z qx qy qz qw of that frame in the map; None while it is not observable, and `why`.
    covariance: (6, 6) in ROS order, about the axes of the map: m, rad; None where it is not determined. It is that of the earth as seen
    from the first pose, and so says how well the trajectory as a whole is laid and turned: where fixes hold the map, the map's frame
    itself is fixed to the earth, and has no error of its own.
    """

    origin: tuple[float, float, float] | None
    pose: Array | None = None
    covariance: Array | None = None
    why: str = ""

    @property
    def yaw(self) -> float | None:
        """rad, of the map's x axis, from east to north."""
        if self.pose is None:
            return None
        earth_R_map = matrix_of(self.pose)[:3, :3].T
        return atan2(earth_R_map[1, 0], earth_R_map[0, 0])

    @property
    def sigma_yaw(self) -> float | None:
        """rad, of how the trajectory is turned, at its first pose."""
        return None if self.covariance is None else sqrt(self.covariance[5, 5])

    def on_earth(self, points: Array) -> Array:
        """(..., 3) m in the map to m east, north, up of the origin. the pose must be known."""
        assert self.pose is not None
        earth_T_map = inverse_of(matrix_of(self.pose))
        return np.asarray(points @ earth_T_map[:3, :3].T + earth_T_map[:3, 3])

    def as_json(self) -> dict[str, Any]:
        """covariance: 36 numbers, row by row. why: only where there is something to say."""
        told: dict[str, Any] = {
            "origin": None if self.origin is None else list(self.origin),
            "map_T_earth": None if self.pose is None else self.pose.tolist(),
            "yaw": self.yaw,
            "sigma_yaw": self.sigma_yaw,
            "covariance": None if self.covariance is None else self.covariance.ravel().tolist(),
        }
        return {**told, "why": self.why} if self.why else told

    @staticmethod
    def from_json(told: dict[str, Any]) -> "Georeference":
        """KeyError, TypeError or ValueError if `as_json` did not say it."""
        origin, pose, covariance = (
            None if told[name] is None else np.array(told[name], dtype=np.float64).reshape(shape)
            for name, shape in (("origin", (3,)), ("map_T_earth", (7,)), ("covariance", (6, 6)))
        )
        place = None if origin is None else _place(origin.tolist())
        return Georeference(place, pose, covariance, told.get("why", ""))


def georeference(
    space: Space,
    estimate: Estimate,
    origin: Sequence[float] | None,
    first: int | None,
    holds: Callable[[str], bool],
    why: str,
) -> Georeference:
    """first: the variable of the first pose that is connected with the earth. holds: whether a factor is in the graph.
    why: what is said of a map that has no place on the earth.
    """
    place = None if origin is None else _place(origin)
    if not estimate.knows(EARTH):
        return Georeference(place, why=why)
    earth: Pose = estimate.pose(EARTH)
    seven = np.array(space.seven(earth))
    try:
        if holds(DATUM) and first is not None:
            carried = earth.between(estimate.pose(first)).AdjointMap()
            tangent = carried @ estimate.covariance([first]) @ carried.T
        else:
            tangent = estimate.covariance([EARTH])
    except SlamError:
        return Georeference(place, seven)
    return Georeference(place, seven, space.covariance_to_ros(tangent, earth))


def _place(numbers: Sequence[float]) -> tuple[float, float, float]:
    latitude, longitude, altitude = map(float, numbers)
    return latitude, longitude, altitude
