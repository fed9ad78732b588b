"""Changes: whole, or without what cannot be solved; parts that they connect are moved first."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from slam_backend.core.apply import Applier, touched, without
from slam_backend.core.config import OdometrySource, config_from
from slam_backend.core.errors import SolverFailure
from slam_backend.core.graph import UNTIL_JOINED, Delta, Factor
from slam_backend.core.parts import Parts
from slam_backend.core.solvers.isam2 import Isam2
from slam_backend.core.space import SPACES

NOISE = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
ORIGIN, STEP = gtsam.Pose2(), gtsam.Pose2(1, 0, 0.1)


@pytest.fixture
def applier():
    config = config_from({"space": "2d", "sources": ["o"], "o": OdometrySource().model_dump()})
    woken = []
    made = Applier(Isam2(config, SPACES["2d"]), SPACES["2d"], Parts(), woken.append)
    made.woken = woken
    return made


def gauge(k):
    prior = gtsam.PriorFactorPose2(X(k), ORIGIN, NOISE)
    return Factor(f"gauge/{k}/0", "gauge", prior, (X(k),), k)


def edge(i, j, measured=STEP, kind="motion", name="wheels", noise=NOISE):
    return Factor(
        f"{name}/{i}-{j}/0",
        kind,
        gtsam.BetweenFactorPose2(X(i), X(j), measured, noise),
        (X(i), X(j)),
        j,
        (i, j),
    )


def sight(k, n, distance=2.0):
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 0.1)
    factor = gtsam.BearingRangeFactor2D(X(k), L(n), gtsam.Rot2(0.5), distance, noise)
    return Factor(f"trees/{k}/{n}", "landmark", factor, (X(k), L(n)), k)


def fix(k, pose):
    return Factor(f"fixes/{k}/0", "pose", gtsam.PriorFactorPose2(X(k), pose, NOISE), (X(k),), k)


def begin(applier, first, count):
    """A part of the graph: a chain of `count` poses from X(first) at the origin."""
    applier._parts.begin(X(first), f"gauge/{first}/0")
    applier.apply(Delta((gauge(first),), values={X(first): ORIGIN}))
    for k in range(first + 1, first + count):
        applier._parts.put(X(k), X(k - 1))
        guess = applier.estimate.pose(X(k - 1)).compose(STEP)
        applier.apply(Delta((edge(k - 1, k),), values={X(k): guess}))


def guess_of(applier, k, n):
    return {L(n): applier.estimate.pose(X(k)).transformFrom(2 * gtsam.Rot2(0.5).matrix()[:, 0])}


def test_what_cannot_be_solved_is_left_out_with_a_decision_and_the_rest_goes_in(applier):
    begin(applier, 0, 4)
    bad = edge(0, 2, gtsam.Pose2(np.nan, 0, 0), "loop", "loops")
    good = edge(0, 3, STEP.compose(STEP).compose(STEP), "loop", "loops")
    applier.apply(Delta((bad, good, sight(3, 0)), values=guess_of(applier, 3, 0)))
    decisions = applier.take_decisions()
    assert [(d.id, d.verdict, f"{d.stage}/{d.reason}") for d in decisions if d.source != "solver"] == [
        ("loops/0-2/0", "refused", "solver/unsolvable"),
        ("loops/0-3/0", "accepted", "admit/unjudged"),
    ]
    assert {"loops/0-3/0", "trees/3/0"} < set(applier._solver.factors)
    assert applier.woken == [L(0)]
    assert applier.take_decisions() == []


def test_a_change_whose_motion_cannot_be_solved_is_not_applied_at_all(applier):
    begin(applier, 0, 3)
    applier._parts.put(X(3), X(2))
    kept = set(applier._solver.factors)
    bad = edge(2, 3, gtsam.Pose2(np.nan, 0, 0))
    with pytest.raises(SolverFailure):
        applier.apply(Delta((bad, sight(3, 0)), values={X(3): ORIGIN, L(0): np.zeros(2)}))
    assert set(applier._solver.factors) == kept
    assert [d.id for d in applier.take_decisions() if d.verdict == "refused"] == [bad.id]


def test_a_loop_between_parts_moves_the_later_one_with_its_landmarks(applier):
    begin(applier, 0, 4)
    begin(applier, 10, 4)
    applier.apply(Delta((sight(12, 0),), values=guess_of(applier, 12, 0)))
    seen = applier.estimate.pose(X(12)).transformTo(applier.estimate.point(L(0)))
    there = gtsam.Pose2(5, -3, 2)
    applier.apply(Delta((edge(2, 11, there, "loop", "loops"),)))
    pose = applier.estimate.pose
    assert pose(X(2)).between(pose(X(11))).equals(there, 1e-6)
    assert pose(X(0)).equals(ORIGIN, 1e-6)
    np.testing.assert_allclose(pose(X(12)).transformTo(applier.estimate.point(L(0))), seen, atol=1e-6)
    assert "gauge/10/0" not in applier._solver.factors
    assert len(applier._parts) == 1
    assert applier.woken[-1] == UNTIL_JOINED


def test_a_loop_from_the_later_part_to_the_earlier_one_moves_the_later_one_too(applier):
    begin(applier, 0, 4)
    begin(applier, 10, 4)
    there = gtsam.Pose2(5, -3, 2)
    applier.apply(Delta((edge(11, 2, there.inverse(), "loop", "loops"),)))
    pose = applier.estimate.pose
    assert pose(X(2)).between(pose(X(11))).equals(there, 1e-6)
    assert pose(X(0)).equals(ORIGIN, 1e-6)


def test_a_part_with_absolute_poses_stays_and_the_other_comes_to_it(applier):
    begin(applier, 0, 4)
    begin(applier, 10, 4)
    home = gtsam.Pose2(100, 50, 1)
    applier.apply(Delta((fix(11, home),)))
    assert "gauge/10/0" not in applier._solver.factors
    assert applier.estimate.pose(X(0)).equals(ORIGIN, 1e-6)
    applier.apply(Delta((edge(2, 11, STEP, "loop", "loops"),)))
    assert applier.estimate.pose(X(11)).equals(home, 1e-6)
    assert applier.estimate.pose(X(2)).equals(home.compose(STEP.inverse()), 1e-6)
    assert not any(name.startswith("gauge") for name in applier._solver.factors)
    assert len(applier._parts) == 1


def test_two_parts_with_absolute_poses_are_joined_without_a_move(applier):
    begin(applier, 0, 4)
    begin(applier, 10, 4)
    applier.apply(Delta((fix(0, ORIGIN), fix(10, gtsam.Pose2(5, 0, 0)))))
    applier.apply(Delta((edge(0, 10, gtsam.Pose2(5.1, 0, 0), "loop", "loops"),)))
    assert len(applier._parts) == 1
    assert applier.estimate.pose(X(10)).x() == pytest.approx(5.033, abs=1e-3)


def test_a_joint_that_cannot_be_solved_leaves_both_parts_as_they_were(applier):
    begin(applier, 0, 4)
    begin(applier, 10, 4)
    applier.apply(Delta((edge(2, 11, gtsam.Pose2(np.nan, 0, 0), "loop", "loops"),)))
    assert len(applier._parts) == 2
    assert {"gauge/0/0", "gauge/10/0"} < set(applier._solver.factors)
    assert applier.estimate.values().size() == 8
    applier.apply(Delta((edge(2, 11, STEP, "loop", "loops"),)))
    assert len(applier._parts) == 1


def test_an_absolute_pose_that_cannot_be_solved_leaves_the_gauge(applier):
    begin(applier, 0, 4)
    applier.apply(Delta((fix(2, gtsam.Pose2(np.nan, 0, 0)),)))
    assert "gauge/0/0" in applier._solver.factors
    applier.apply(Delta((fix(2, gtsam.Pose2(7, 0, 0)),)))
    assert "gauge/0/0" not in applier._solver.factors
    assert applier.estimate.pose(X(2)).equals(gtsam.Pose2(7, 0, 0), 1e-6)


def test_without_drops_what_only_the_dropped_factors_touched():
    delta = Delta((sight(1, 0), sight(2, 0), sight(2, 1)), values={L(0): 0, L(1): 1, X(5): 2})
    assert set(without(delta, {"trees/2/0", "trees/2/1"}).values) == {L(0), X(5)}
    assert without(delta, ()) is delta


def test_touched_keeps_first_guesses_that_a_factor_needs():
    assert set(touched(Delta((sight(1, 0),), values={L(0): 0, L(1): 1})).values) == {L(0)}
