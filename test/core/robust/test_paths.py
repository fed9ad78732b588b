"""What the graph says between two poses: along odometry exactly, over loops by the cheapest way."""

import numpy as np
import pytest

from slam_backend.core.graph import Delta, Factor, Motion, keyframe
from slam_backend.core.robust.paths import Paths
from slam_backend.core.space import SPACES


def key(n):
    return keyframe(n, 0).pose


def edge(space, i, j, pose, covariance, kind="motion"):
    import gtsam

    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return Factor(f"{kind}/{i}-{j}", kind, space.between(key(i), key(j), pose, noise), (key(i), key(j)), 0)


@pytest.fixture(params=["2d", "3d"])
def world(request):
    """Thirty random steps and their factors."""
    space, rng = SPACES[request.param], np.random.default_rng(4)
    steps = []
    for _ in range(30):
        root = rng.normal(0, 0.05, (space.dimension,) * 2)
        steps.append(
            Motion(
                space.expmap(rng.normal(0, 0.5, space.dimension)),
                root @ root.T + 1e-4 * np.eye(space.dimension),
            )
        )
    paths = Paths(space, 1.0, {})
    paths.book(Delta(tuple(edge(space, n, n + 1, s.pose, s.covariance) for n, s in enumerate(steps))))
    return space, steps, paths


def test_along_odometry_is_the_steps_one_after_the_other(world):
    space, steps, paths = world
    expected = steps[4]
    for step in steps[5:17]:
        expected = expected.then(step)
    found = paths.along(key(4), key(17))
    assert found.pose.equals(expected.pose, 1e-9)
    np.testing.assert_allclose(found.odometry, expected.covariance, atol=1e-10)
    assert found.meters == pytest.approx(sum(space.size(s.pose)[0] for s in steps[4:17]))
    back, turned = paths.along(key(17), key(4)), expected.inverse()
    assert back.pose.equals(turned.pose, 1e-9)
    np.testing.assert_allclose(back.odometry, turned.covariance, atol=1e-10)


def test_noise_of_rotation_is_scaled_apart(world):
    """As if each step had been stated with it."""
    space, steps, paths = world
    turns = np.diag(space.diagonal(1.0, 0.0)) > 0
    expected = Motion(space.identity, np.zeros((space.dimension,) * 2))
    for step in steps[2:9]:
        more = step.covariance.copy()
        more[np.ix_(turns, turns)] *= 9
        expected = expected.then(Motion(step.pose, more))
    found = paths.along(key(2), key(9))
    np.testing.assert_allclose(found.covariance(2.0, rotation=3.0), 2 * expected.covariance, atol=1e-9)


def test_the_cheapest_way_takes_a_loop_that_makes_it_shorter_and_not_one_that_is_left_out(world):
    space, steps, paths = world
    loop = edge(space, 2, 27, space.identity, 1e-4 * np.eye(space.dimension), "loop")
    paths.book(Delta((loop,)))
    found = paths.cheapest((key(1), key(28)))
    assert found.via == (loop.id,)
    expected = steps[1].pose.compose(steps[27].pose)
    assert found.pose.equals(expected, 1e-9)
    np.testing.assert_allclose(np.diag(found.loops) > 0, True)
    assert paths.cheapest((key(28), key(1))).pose.equals(expected.inverse(), 1e-9)
    assert paths.cheapest((key(10), key(11))).via == ()
    assert paths.cheapest((key(1), key(28)), without=[loop.id]).via == ()
    paths.book(Delta(remove=(loop.id,)))
    assert paths.cheapest((key(1), key(28))).via == ()


def test_two_chains_are_connected_by_the_loop_between_them_or_not_at_all(world):
    space, steps, paths = world
    paths.book(
        Delta(tuple(edge(space, 100 + n, 101 + n, s.pose, s.covariance) for n, s in enumerate(steps[:5])))
    )
    assert paths.cheapest((key(3), key(103))) is None
    loop = edge(space, 5, 101, space.identity, 1e-4 * np.eye(space.dimension), "loop")
    paths.book(Delta((loop,)))
    assert paths.cheapest((key(3), key(103))).via == (loop.id,)
    assert paths.along(key(3), key(103)) is None
