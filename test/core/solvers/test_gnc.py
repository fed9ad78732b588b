"""Graduated non-convexity: wrong loops are named, however far the start has drifted; it can be broken off anywhere."""

from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from slam_backend.core.graph import Factor
from slam_backend.core.robust.chi2 import chi2_quantile
from slam_backend.core.solvers.batch import solve
from slam_backend.core.solvers.descent import Options
from slam_backend.core.solvers.gnc import INLIERS, Graduation, solve_gnc
from slam_backend.core.solvers.initialize import initialize
from slam_backend.core.space import SPACES
from slam_backend.io.formats import read_graph
from slam_backend.io.problem import problem_of

DATA = Path(__file__).parents[3] / "../shared/data"
ROUNDS = 2


@pytest.fixture(params=["2d", "3d"])
def space(request):
    return SPACES[request.param]


def edge(space, i, j, measured, sigma):
    noise = gtsam.noiseModel.Isotropic.Sigma(space.dimension, sigma)
    kind = "motion" if j - i == 1 else "loop"
    return Factor(f"edges/{i}-{j}", kind, space.between(X(i), X(j), measured, noise), (X(i), X(j)), j)


def drive(space, bias=0.0, sigma=0.02, count=60):
    """Twice around a circle by odometry that turns too far by `bias` a step, and true loops from round to round."""
    rng = np.random.default_rng(7)
    turn = 2 * np.pi / count * ROUNDS

    def step(more):
        return space.from_extrinsics((1.0, 0.0, 0.0, 0.0, 0.0, turn + more))

    def noisy(pose):
        return pose.compose(space.expmap(rng.normal(0, sigma, space.dimension)))

    odometry = [edge(space, i, j, noisy(step(bias)), sigma) for i, j in pairwise(range(count))]
    loops = [
        edge(space, i, i + count // ROUNDS, noisy(space.identity), sigma)
        for i in range(0, count // ROUNDS, 2)
    ]
    wrong = [
        edge(space, i, i + 20, space.expmap(rng.normal(0, 2, space.dimension)), sigma)
        for i in range(5, 35, 4)
    ]
    return odometry, loops, wrong


def ids(factors):
    return {factor.id for factor in factors}


def test_wrong_loops_are_named_and_the_rest_is_solved_without_them(space):
    odometry, loops, wrong = drive(space)
    start = initialize([*odometry, *loops], None, "odometry").values
    right = solve([*odometry, *loops], start, Options(polish=True))
    judged = solve_gnc([*odometry, *loops, *wrong], start, Options(polish=True))
    assert set(judged.refused) == ids(wrong)
    assert judged.solution.cost == pytest.approx(right.cost, rel=1e-9)


def test_a_drifted_start_refuses_nothing_that_is_true(space):
    """Costs of a hundred thousand make every first weight nearly zero: that is no verdict."""
    odometry, loops, wrong = drive(space, bias=0.004, sigma=0.004)
    start = initialize([*odometry, *loops], None, "odometry").values
    graduation = Graduation([*odometry, *loops, *wrong], start)
    assert graduation.costs().max() > 1e5
    while not graduation.advance():
        pass
    assert graduation.refused == ids(wrong)


def test_where_nothing_contradicts_anything_nothing_is_refused(space):
    odometry, loops, _ = drive(space)
    start = initialize([*odometry, *loops], None, "odometry").values
    graduation = Graduation([*odometry, *loops], start)
    assert not graduation.refused
    while not graduation.advance():
        pass
    assert graduation.weights.tolist() == [1.0] * len(loops)


def test_every_verdict_is_that_of_the_truncation(space):
    """At the end a loop is in exactly if its own cost is within the quantile, or it would be once in (Black & Rangarajan)."""
    odometry, loops, wrong = drive(space)
    start = initialize([*odometry, *loops], None, "odometry").values
    graduation = Graduation([*odometry, *loops, *wrong], start)
    while not graduation.advance():
        pass
    within = graduation.costs() <= chi2_quantile(INLIERS, space.dimension) / 2
    assert within.tolist() == (graduation.weights > 0).tolist()


def test_it_can_be_broken_off_between_any_two_iterations(space):
    odometry, loops, wrong = drive(space)
    start = initialize([*odometry, *loops], None, "odometry").values
    seen = []

    def watch(step):
        seen.append(step)
        if len(seen) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        solve_gnc([*odometry, *loops, *wrong], start, progress=watch)
    assert len(seen) == 3


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason="the data lies beside the checkout")
@pytest.mark.parametrize(("sequence", "least"), [("00", 117), ("05", 60), ("07", 1)])
def test_real_loops_most_of_them_wrong(sequence, least):
    """Visual odometry that has drifted by tens of metres; gtsam's own optimizer refuses all, or ends metres off."""
    path = DATA / f"kitti_vo_loops/{sequence}/kitti_{sequence}_alpha_0.15.g2o"
    true = {line for line in path.with_name(f"{path.stem}_GT_LC.txt").read_text().splitlines() if line}
    problem = problem_of(read_graph(path))
    graduation = Graduation(problem.factors, initialize(problem.factors, problem.stated, "odometry").values)
    while not graduation.advance():
        pass
    kept = {" ".join(map(problem.name, f.keys)) for f in graduation.loops if f.id not in graduation.refused}
    assert kept <= true
    assert len(kept) >= least
