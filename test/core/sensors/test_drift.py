"""Poses that drift move the residuals of what is seen from them together, by as much as is said."""

import numpy as np
import pytest

from slam_backend.core.sensors.drift import Drift
from slam_backend.core.space import SPACES

ARM = np.array([0.5, -0.3, 0.2])  # m, of the sensor on the robot
COUNT = 6  # poses; the fourth is in the middle


@pytest.fixture(params=["2d", "3d"])
def space(request):
    return SPACES[request.param]


def drawn(space, rng, covariance):
    return space.expmap(rng.multivariate_normal(np.zeros(space.dimension), covariance))


def drifted(space, rng, poses, steps):
    """The same way, the middle pose where it is, each step with its error."""
    middle, moved = len(poses) // 2, list(poses)
    for k in range(middle + 1, len(poses)):
        step = poses[k - 1].between(poses[k])
        moved[k] = moved[k - 1].compose(step).compose(drawn(space, rng, steps[k - 1]))
    for k in range(middle, 0, -1):
        step = poses[k - 1].between(poses[k]).compose(drawn(space, rng, steps[k - 1]))
        moved[k - 1] = moved[k].compose(step.inverse())
    return moved


def turn(space, before, after):
    """By which a pose has turned, in the map."""
    whole = after.rotation().matrix() @ before.rotation().matrix().T
    pose = space.rigid(whole, np.zeros(space.point_dimension))
    rotation = np.setdiff1d(np.arange(space.dimension), np.arange(space.dimension)[space.translation])
    return space.logmap(pose)[rotation]


def test_the_covariance_is_that_of_ways_that_were_drawn(space, agree, spread):
    rng, d = np.random.default_rng(1), space.point_dimension
    arm, turns = ARM[:d], space.dimension - d
    poses = [space.identity]
    for _ in range(COUNT - 1):
        poses.append(poses[-1].compose(space.expmap(rng.normal(0, 0.4, space.dimension))))
    steps = [spread(rng, np.full(space.dimension, 1e-3)) for _ in range(COUNT - 1)]
    at = np.array([0, 2, 4, 5])
    by_place, by_turn = rng.normal(size=(4, d)), rng.normal(size=(4, turns))
    places = np.array([poses[k].transformFrom(arm) for k in at])
    errors = []
    for _ in range(600):
        moved = drifted(space, rng, poses, steps)
        gone = np.array([moved[k].transformFrom(arm) for k in at]) - places
        turned = np.array([turn(space, poses[k], moved[k]) for k in at])
        errors.append((by_place * gone).sum(axis=1) + (by_turn * turned).sum(axis=1))
    agree(errors, Drift(poses, steps).covariance(at, places, by_place, by_turn))


def test_a_way_of_one_pose_does_not_drift(space):
    d = space.point_dimension
    found = Drift([space.identity], []).covariance(
        np.zeros(3, dtype=int), np.zeros((3, d)), np.ones((3, d)), np.ones((3, space.dimension - d))
    )
    assert not found.any()
