"""How two parts lie to each other, from landmarks that both know: against motions that are known."""

import gtsam
import numpy as np
import pytest

from slam_backend.core.graph import Offer, Seen, Wait
from slam_backend.core.measurement import Measurement
from slam_backend.core.reunion import reunion
from slam_backend.core.space import SPACES

SHIFTS = {
    "2d": gtsam.Pose2(3, -2, 2.5),
    "3d": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.5, 2.5), np.array([3, -2, 1.0])),
}


class World:
    """Pose n of part 1 stands at its own place; landmark n of part 0 is where `shift` brings what the pose sees."""

    def __init__(self, name, count, seed, line=False):
        rng = np.random.default_rng(seed)
        self.space, self.shift = SPACES[name], SHIFTS[name]
        size = self.space.point_dimension
        self.poses = [self.space.expmap(rng.normal(size=self.space.dimension)) for _ in range(count)]
        points = rng.normal(0, 5, (count, size)) * ([1, *[1e-3] * (size - 1)] if line else 1)
        self.points = [self.shift.transformFrom(point) for point in points]
        self.seen = [pose.transformTo(point) for pose, point in zip(self.poses, points, strict=True)]

    def pose(self, key):
        return self.poses[key]

    def point(self, key):
        return self.points[key - 100]

    def found(self):
        waits = [
            Wait(Offer(str(n), Measurement(n, "trees")), 0, "", Seen(n, 100 + n, seen))
            for n, seen in enumerate(self.seen)
        ]
        return reunion(self.space, waits, self, lambda key: int(key < 100))


@pytest.mark.parametrize("name", ["2d", "3d"])
def test_the_shift_is_found_and_a_stray_one_left_out(name):
    world = World(name, 7, 1)
    world.seen[3] = world.seen[3] + 4.0
    found = world.found()
    assert (found.part, found.to) == (1, 0)
    assert found.shift.equals(world.shift, 1e-9)
    assert [wait.offer.id for wait in found.waits] == ["0", "1", "2", "4", "5", "6"]


@pytest.mark.parametrize("name", ["2d", "3d"])
def test_one_landmark_more_is_asked_for_than_determines_it(name):
    size = SPACES[name].point_dimension
    assert World(name, size, 2).found() is None
    assert World(name, size + 1, 2).found() is not None


def test_landmarks_on_a_line_do_not_tell_how_space_is_turned_about_it():
    assert World("3d", 6, 3, line=True).found() is None
    assert World("2d", 6, 3, line=True).found() is not None
