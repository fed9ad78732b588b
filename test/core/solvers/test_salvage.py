"""A graph that was solved once, and cannot be solved again: what can be kept is kept, and the rest is named."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from slam_backend.core.config import config_from
from slam_backend.core.errors import SolverFailure
from slam_backend.core.graph import Delta, Factor
from slam_backend.core.solvers.isam2 import Isam2
from slam_backend.core.space import SPACES

NOISE = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
COUNT = 30
FORWARD = gtsam.Pose2(1, 0, 0)


class Moody:
    """A measurement between two poses that can be solved until its mood changes."""

    def __init__(self, measured):
        self.good, self._measured = True, measured

    def factor(self, *keys):
        native = gtsam.BetweenFactorPose2(*keys, self._measured, NOISE)

        def error(this, values, jacobians):
            if not self.good:
                raise ZeroDivisionError("not today")
            if jacobians is not None:
                matrix, _ = native.linearize(values).jacobian()
                for n in range(2):
                    jacobians[n] = matrix[:, 3 * n : 3 * n + 3] * 0.1
            return native.unwhitenedError(values)

        return gtsam.CustomFactor(NOISE, list(keys), error)


def motion(k, factor=None):
    keys = X(k - 1), X(k)
    factor = factor or gtsam.BetweenFactorPose2(*keys, FORWARD, NOISE)
    return Factor(f"wheels/{k}", "motion", factor, keys, k)


def driven(first=None):
    """A straight drive past a landmark, with two loops; first: of its motion."""
    config = config_from({"space": "2d", "sources": ["o"], "o": {"kind": "odometry"}})
    solver = Isam2(config, SPACES["2d"])
    prior = gtsam.PriorFactorPose2(X(0), gtsam.Pose2(), NOISE)
    solver.update(Delta((Factor("gauge/0", "gauge", prior, (X(0),), 0),), values={X(0): gtsam.Pose2()}))
    for k in range(1, COUNT):
        made = first.factor(X(0), X(1)) if first is not None and k == 1 else None
        solver.update(Delta((motion(k, made),), values={X(k): gtsam.Pose2(k, 0, 0)}))
    sight = gtsam.BearingRangeFactor2D(
        X(4), L(0), gtsam.Rot2(np.pi / 2), 3.0, gtsam.noiseModel.Isotropic.Sigma(2, 0.1)
    )
    solver.update(
        Delta((Factor("trees/4", "landmark", sight, (X(4), L(0)), 4),), values={L(0): np.array([4.0, 3.0])})
    )
    return solver


def loop(i, j, factor=None):
    factor = factor or gtsam.BetweenFactorPose2(X(i), X(j), gtsam.Pose2(j - i, 0, 0), NOISE)
    return Factor(f"loops/{i}-{j}", "loop", factor, (X(i), X(j)), j)


def fail(solver):
    """A change that cannot be solved, so that the solver must be what it was."""
    bad = loop(3, 20, gtsam.BetweenFactorPose2(X(3), X(20), gtsam.Pose2(np.nan, 0, 0), NOISE))
    with pytest.raises(SolverFailure) as failure:
        solver.update(Delta((bad,)))
    assert failure.value.guilty == (bad.id,)
    return {d.id for d in solver.incidents() if (d.verdict, d.reason) == ("removed", "withdrawn")}


def agrees(solver):
    """The store and iSAM2 hold the same; the estimate is the drive."""
    held = solver._isam.getFactorsUnsafe()
    assert {solver._slots[id_] for id_ in solver.factors} == {n for n in range(held.size()) if held.exists(n)}
    for k in range(COUNT):
        pose = solver._believed.pose(X(k))
        np.testing.assert_allclose([pose.x(), pose.y(), pose.theta()], [k, 0, 0], atol=1e-6)


def test_what_cannot_be_solved_any_more_is_let_go_of_alone() -> None:
    solver, moody = driven(), Moody(gtsam.Pose2(10, 0, 0))
    for each in (loop(2, 15), loop(5, 15, moody.factor(X(5), X(15))), loop(6, 25)):
        solver.update(Delta((each,)))
    before = set(solver.factors)
    moody.good = False
    assert fail(solver) == {"loops/5-15"}
    assert set(solver.factors) == before - {"loops/5-15"}
    assert solver._believed.knows(L(0))
    agrees(solver)
    solver.update(Delta(remove=("loops/5-15", "loops/2-15")))
    solver.update(Delta((motion(COUNT),), values={X(COUNT): gtsam.Pose2(COUNT, 0, 0)}))
    assert set(solver.factors) == before - {"loops/5-15", "loops/2-15"} | {f"wheels/{COUNT}"}
    agrees(solver)


def test_a_part_that_the_earth_held_is_held_by_one_of_its_poses() -> None:
    """And by the earth again, as far as that can be solved."""
    solver, moody = driven(), Moody(gtsam.Pose2(10, 0, 0))
    noise = gtsam.noiseModel.Diagonal.Sigmas([0.1, 0.1, 1e6])
    earth = gtsam.symbol("e", 0)
    prior = gtsam.PriorFactorPose2(earth, gtsam.Pose2(), NOISE)
    fixes = [
        Factor(
            f"fixes/{k}",
            "gnss",
            gtsam.BetweenFactorPose2(earth, X(k), gtsam.Pose2(k, 0, 0), noise),
            (X(k), earth),
            k,
        )
        for k in range(0, COUNT, 5)
    ]
    datum = Factor("datum", "datum", prior, (earth,), 0)
    solver.update(Delta((datum, *fixes), ("gauge/0",), {earth: gtsam.Pose2()}))
    solver.update(Delta((loop(5, 15, moody.factor(X(5), X(15))),)))
    before = set(solver.factors)
    moody.good = False
    assert fail(solver) == {"loops/5-15"}
    assert set(solver.factors) == before - {"loops/5-15"} | {"gauge/x0"}
    agrees(solver)


def test_where_not_even_the_motion_can_be_solved_every_pose_stays_where_it_was() -> None:
    moody = Moody(FORWARD)
    solver = driven(moody)
    moody.good = False
    assert fail(solver) >= {f"wheels/{k}" for k in range(1, COUNT)}
    assert {factor.kind for factor in solver.factors.values()} == {"gauge"}
    assert len(solver.factors) == COUNT
    assert not solver._believed.knows(L(0))
    agrees(solver)
    solver.update(Delta((motion(COUNT),), values={X(COUNT): gtsam.Pose2(COUNT, 0, 0)}))
    assert solver._believed.pose(X(COUNT)).x() == pytest.approx(COUNT)
