"""How the map lies on the earth: its covariance is that of an earth that is free beside a first pose that is held."""

import json

import gtsam
import numpy as np
import pytest

from slam_backend.core.geometry import covariance_from_ros
from slam_backend.core.georeference import Georeference
from slam_backend.core.graph import DATUM, EARTH


def beside_a_first_pose(found):
    """The same graph the other way round: every fix reaches from the earth to a pose, and only the first pose is held."""
    space, earth = found.space, found.estimate.pose(EARTH)
    first = found.timeline.keyframes[0].pose
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(
        space.prior(
            first, found.estimate.pose(first), gtsam.noiseModel.Isotropic.Sigma(space.dimension, 1e-5)
        )
    )
    for each in found.solver.factors.values():
        if each.kind == "gnss":
            measured, (key,) = earth.between(each.factor.prior()), each.keys
            graph.push_back(space.between(EARTH, key, measured, each.factor.noiseModel()))
        elif each.id != DATUM:
            graph.push_back(each.factor)
    marginals = gtsam.Marginals(graph, found.estimate.values())
    return marginals.marginalCovariance(EARTH)


@pytest.mark.parametrize("space", ["2d", "3d"])
def test_the_covariance_is_that_of_the_earth_as_seen_from_the_first_pose(road, space):
    found = road.backend(space, earth={"origin": road.origin})
    road.run(found, road.drive(space)[0])
    assert DATUM in found.solver.factors
    told = found.georeference()
    assert told.origin == road.origin
    turn = found.estimate.pose(EARTH).rotation().matrix()
    full = np.eye(3)
    full[: len(turn), : len(turn)] = turn
    tangent = covariance_from_ros(told.covariance, full)
    used = (3, 4, 2) if space == "2d" else range(6)
    expected = beside_a_first_pose(found)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(tangent[np.ix_(used, used)] / scale, expected / scale, atol=2e-3)


@pytest.mark.parametrize("space", ["2d", "3d"])
def test_the_trajectory_is_turned_as_far_off_as_the_sigma_of_the_yaw_says(road, space):
    """Of the trajectory, at its first pose: the chi-square of twelve drives lies within its 99.9 % bounds."""
    squares = []
    for seed in range(12):
        items, truth = road.drive(space, seed, seconds=40)
        found = road.backend(space, earth={"origin": road.origin})
        road.run(found, items)
        believed = found.estimate.pose(EARTH).between(found.estimate.pose(found.timeline.keyframes[0].pose))
        x, y, *_ = truth[0].between(believed).rotation().matrix()[:, 0]
        squares.append(np.arctan2(y, x) ** 2 / found.georeference().sigma_yaw ** 2)
    assert 2.2 < sum(squares) < 32.9


def test_what_is_not_known_yet_is_said_and_survives_a_file(road):
    found = road.backend("2d")
    assert found.georeference() is None  # nothing has come
    road.run(found, road.drive("2d", seconds=4)[0])
    told = found.georeference()
    assert (told.pose, told.covariance, told.yaw, told.sigma_yaw) == (None, None, None, None)
    assert told.why.startswith("yaw not yet observable: the fixes reach over")
    assert told.origin == found.origin
    assert Georeference.from_json(json.loads(json.dumps(told.as_json()))).as_json() == told.as_json()


def test_a_robot_without_a_receiver_has_no_place_on_the_earth(laps):
    from slam_backend.core.backend import Backend

    backend = Backend()
    for item in laps[:10]:
        backend.add(item)
    assert backend.snapshot().earth is None
