"""Whatever a variable is, it can be read, moved with the map, remembered from a pose, and told in numbers."""

import gtsam
import numpy as np
import pytest

from slam_backend.core.space import SPACES
from slam_backend.core.variables import KINDS, is_posed, largest, moved, numbers, value_in

SHIFT = {"2d": gtsam.Pose2(3, -1, 2.0), "3d": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 2.0), (3, -1, 5))}
POSE = {"2d": gtsam.Pose2(1, 2, 0.5), "3d": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), (1, 2, 3))}


def value_of(letter, space):
    if letter in "xte":
        return POSE[space]
    if letter == "b":
        return gtsam.imuBias.ConstantBias(np.array([0.1, 0.2, 0.3]), np.array([0.01, 0.02, 0.03]))
    return np.array([1.0, 2.0] if letter == "l" and space == "2d" else [1.0, 2.0, 3.0])


# a plane has no velocity and no bias: no inertial factor works there
CASES = [(letter, "3d") for letter in KINDS] + [(letter, "2d") for letter in "xtelc"]


@pytest.mark.parametrize(("letter", "space"), CASES)
def test_each_kind_goes_there_and_back(letter, space) -> None:
    key, value, shift = gtsam.symbol(letter, 7), value_of(letter, space), SHIFT[space]
    values = gtsam.Values()
    values.insert(key, value)
    there = SPACES[space]
    read = value_in(there, values, key)
    assert numbers(there, key, read) == pytest.approx(numbers(there, key, value), abs=0)
    back = moved(shift, key, moved(shift.inverse(), key, read))
    assert numbers(there, key, back) == pytest.approx(numbers(there, key, value), abs=1e-12)
    stays = letter in "bc"
    assert (numbers(there, key, moved(shift, key, read)) == numbers(there, key, read)) == stays
    values.update(key, moved(shift, key, read))  # of the same type still
    assert is_posed(key) == (letter in "xte")
    assert largest(there, key, read) >= 0.1 or letter == "b"


def test_the_largest_number_is_not_a_number_where_one_is_not() -> None:
    assert np.isnan(largest(SPACES["3d"], gtsam.symbol("v", 0), np.array([1.0, np.inf, 0.0])))
    assert largest(SPACES["3d"], gtsam.symbol("v", 0), np.array([1.0, -4.0, 0.0])) == 4.0


def test_a_moved_part_of_the_map_keeps_its_inner_geometry() -> None:
    """A velocity turns with the map; a point and a pose keep where they are as seen from a pose."""
    shift, pose = SHIFT["3d"], POSE["3d"]
    point, velocity = np.array([4.0, 5.0, 6.0]), np.array([1.0, 0.0, 0.0])
    l, v = gtsam.symbol("l", 0), gtsam.symbol("v", 0)
    before, after = (
        moved(pose.inverse(), l, point),
        moved(shift.compose(pose).inverse(), l, moved(shift, l, point)),
    )
    assert after == pytest.approx(before)
    assert moved(shift, v, velocity) == pytest.approx(shift.rotation().matrix()[:, 0])
