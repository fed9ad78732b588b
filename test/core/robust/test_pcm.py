"""Pairwise consistency: the largest set of loops that agree is what stays; cycles are closed as gtsam closes them."""

import gtsam
import numpy as np
import pytest

from slam_backend.core.config import Config
from slam_backend.core.graph import Delta, Factor, keyframe
from slam_backend.core.measurement import SECOND
from slam_backend.core.robust.paths import Paths
from slam_backend.core.robust.pcm import Cycles
from slam_backend.core.space import SPACES

from .conftest import ends, vertices


def test_the_largest_set_that_agrees_stays_and_the_rest_does_not(drive):
    true = drive.true(2, 8)
    wrong = drive.wrong((70, 30), (80, 40), (90, 50), (100, 20))
    ended = drive.run([*true, *wrong], robust=["pcm"])
    assert ended.kept == ends(true)
    verdicts = {pair: ended.last[pair] for pair in ends(wrong)}
    assert {d.verdict for d in verdicts.values()} <= {"probation", "removed"}
    assert all(d.statistic < d.threshold for d in verdicts.values())


def test_a_larger_set_that_comes_later_takes_the_place_of_the_first(drive):
    """Two wrong ones that agree are in until three true ones have come."""
    leap = drive.space.from_extrinsics((0.5, 0.0, 0.0, 0.0, 0.0, 0.0))
    wrong = [drive._edge(30 + k, 10 + k, leap) for k in (0, 4)]
    back = drive.truth[34].between(drive.truth[30])
    wrong[1] = drive._edge(34, 14, back.compose(leap).compose(drive.truth[10].between(drive.truth[14])))
    true = drive.true(5, 5)
    ended = drive.run([*wrong, *true], robust=["pcm"])
    assert ended.kept == ends(true)
    told = [d.verdict for d in ended.decisions if d.ends == wrong[1].ends]
    assert told == ["accepted", "removed"]
    absent = set(ended.last[vertices(wrong[1])].basis["absent"])
    three = [loop for loop in true if f"edges/{loop.stamp // SECOND}.000000000/1" in absent]
    assert three == true[:3], "those that had come"
    others = [loop for loop in true if loop not in three]
    assert drive.run([*wrong, *others], robust=["pcm"]).kept == ends(wrong), "without those it is in"


def test_a_lone_loop_waits_and_one_may_be_enough_if_the_settings_say_so(drive):
    assert drive.run(drive.true(5, 1), robust=["pcm"]).kept == set()
    alone = drive.run(drive.true(5, 1), robust=["pcm"], pcm={"smallest": 1})
    assert alone.kept == ends(drive.true(5, 1))


@pytest.mark.parametrize("dimension", ["2d", "3d"])
def test_a_cycle_closes_as_well_as_gtsam_says(dimension):
    """The distance of two loops is the chi-square of the least that moves anything: twice the error at the optimum of
    a chain of two loops and the odometry between, all free.
    """
    space, rng = SPACES[dimension], np.random.default_rng(0)
    paths = Paths(space, 1.0, {})
    d = space.dimension

    def factor(name, i, j, spread):
        root = rng.normal(size=(d, d))
        noise = gtsam.noiseModel.Gaussian.Covariance(spread**2 * (root @ root.T + np.eye(d)))
        pose = space.expmap(rng.normal(0, 0.4, d))
        keys = keyframe(i, 0).pose, keyframe(j, 0).pose
        return Factor(name, "motion" if j == i + 1 else "loop", space.between(*keys, pose, noise), keys, 0)

    motion = [factor(f"m/{k}", k, k + 1, 1e-4) for k in range(9)]
    paths.book(Delta(tuple(motion)))
    cycles = Cycles(paths, 1.0)
    one = factor("one", 1, 7, 1e-4)
    out = [space.pose_of_numbers(space.numbers(f.factor.measured())) for f in motion]
    close = (
        out[1].inverse().compose(out[0].between(out[0])).compose(one.factor.measured()).compose(out[7])
    )  # from 2 to 8 by way of `one`
    near = close.compose(space.expmap(rng.normal(0, 2e-4, d)))
    other = Factor("two", "loop", space.between(keyframe(8, 0).pose, keyframe(2, 0).pose, near.inverse(), one.factor.noiseModel()), (keyframe(8, 0).pose, keyframe(2, 0).pose), 0)  # fmt: skip
    assert cycles.add(one).shape == (0,)
    (distance,) = cycles.add(other)

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for each in (motion[1], motion[7], one, other):
        graph.add(each.factor)
    first = keyframe(1, 0).pose
    graph.add(space.prior(first, space.identity, gtsam.noiseModel.Isotropic.Sigma(d, 1e-6)))
    values.insert(first, space.identity)
    values.insert(keyframe(2, 0).pose, out[1])
    values.insert(keyframe(7, 0).pose, one.factor.measured())
    values.insert(keyframe(8, 0).pose, one.factor.measured().compose(out[7]))
    found = gtsam.GaussNewtonOptimizer(graph, values).optimize()
    assert distance == pytest.approx(2 * graph.error(found), rel=2e-3)


def test_where_no_odometry_leads_nothing_can_be_compared():
    paths = Paths(SPACES["2d"], 1.0, {})
    cycles = Cycles(paths, Config().gate.odometry_scale)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    keys = keyframe(0, 0).pose, keyframe(1, 0).pose
    assert (
        cycles.add(Factor("loop", "loop", gtsam.BetweenFactorPose2(*keys, gtsam.Pose2(), noise), keys, 0))
        is None
    )
