"""The kinds of variables, by the letter of their keys: how each is read, moved with the map, and remembered from a pose.

    x  pose of the base at a keyframe          l  landmark, a point        t  landmark with an orientation (a tag)
    e  a fixed frame in the map (the earth's)  v  velocity in the map      b  bias of an IMU (in its own frame)
    c  calibration: a short vector in no frame

A new kind is a row here; whoever moves, stores or compares variables asks this table.
"""

from collections.abc import Callable, Mapping
from math import isfinite, nan
from typing import Any, NamedTuple

import gtsam
import numpy as np
from gtsam import symbolIndex
from gtsam.symbol_shorthand import X

from .graph import Pose
from .space import Space


class Kind(NamedTuple):
    """read: (space, values, key) -> value. asked: the same, of a gtsam.ISAM2.

    moved: (shift, value) -> the value when all that is in the map is moved by `shift`, `new_T_old`. With a pose as the
    shift it takes what is seen from that pose to where it is; with its inverse, back.
    numbers: (space, value) -> plain numbers that say all of it.
    """

    read: Callable[[Space, gtsam.Values, int], Any]
    asked: Callable[[Space, gtsam.ISAM2, int], Any]
    moved: Callable[[Pose, Any], Any]
    numbers: Callable[[Space, Any], tuple[float, ...]]


def _flat(_: Space, vector: Any) -> tuple[float, ...]:
    return tuple(np.asarray(vector).tolist())


POSE = Kind(
    lambda space, values, key: space.pose_in(values, key),
    lambda space, isam, key: space.estimate(isam, key),
    lambda shift, pose: shift.compose(pose),
    lambda space, pose: space.numbers(pose),
)
POINT = Kind(
    lambda space, values, key: space.point_in(values, key),
    lambda space, isam, key: space.estimate_point(isam, key),
    lambda shift, point: np.asarray(shift.transformFrom(point)),
    _flat,
)
VELOCITY = Kind(
    lambda _, values, key: np.asarray(values.atVector(key)),
    lambda _, isam, key: np.asarray(isam.calculateEstimateVector(key)),
    lambda shift, velocity: np.asarray(shift.rotation().matrix() @ velocity),
    _flat,
)
BIAS = Kind(
    lambda _, values, key: values.atConstantBias(key),
    lambda _, isam, key: isam.calculateEstimateConstantBias(key),
    lambda _, bias: bias,
    lambda _, bias: tuple(bias.vector().tolist()),
)
CALIBRATION = Kind(VELOCITY.read, VELOCITY.asked, lambda _, vector: vector, _flat)

KINDS: Mapping[str, Kind] = {
    "x": POSE, "t": POSE, "e": POSE, "l": POINT, "v": VELOCITY, "b": BIAS, "c": CALIBRATION,
}  # fmt: skip

_BY_CODE = {ord(letter): kind for letter, kind in KINDS.items()}


def kind_of(key: int) -> Kind:
    return _BY_CODE[key >> 56]  # gtsam keeps a symbol's letter in the top byte


def pose_beside(key: int) -> int:
    """Of a velocity or a bias, the pose of the keyframe that has it; of anything else, the variable itself."""
    return int(X(symbolIndex(key))) if kind_of(key) in (VELOCITY, BIAS) else key


def is_posed(key: int) -> bool:
    """Whether the variable is a pose, of the robot or of something else."""
    return kind_of(key) is POSE


def is_point(key: int) -> bool:
    return kind_of(key) is POINT


def value_in(space: Space, values: gtsam.Values, key: int) -> Any:
    return kind_of(key).read(space, values, key)


def estimate_in(space: Space, isam: gtsam.ISAM2, key: int) -> Any:
    return kind_of(key).asked(space, isam, key)


def moved(shift: Pose, key: int, value: Any) -> Any:
    """The value when all that is in the map is moved by `shift`; by the inverse of a pose, the value as seen from there."""
    return kind_of(key).moved(shift, value)


def numbers(space: Space, key: int, value: Any) -> tuple[float, ...]:
    return kind_of(key).numbers(space, value)


def largest(space: Space, key: int, value: Any) -> float:
    """Largest magnitude among its numbers; NaN if one is not finite."""
    found = numbers(space, key, value)
    return max(map(abs, found)) if all(map(isfinite, found)) else nan
