"""The whole graph at once: the same optimum by every way, every stop with its reason, gauges that cost nothing."""

from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from slam_backend.core.errors import SolverFailure
from slam_backend.core.graph import Factor
from slam_backend.core.solvers.batch import polish, solve
from slam_backend.core.solvers.descent import METHODS, NO_FALL, SETTLED, SMALL_STEP, Options
from slam_backend.core.solvers.initialize import cost_of, initialize
from slam_backend.core.solvers.planar import adjoint, between, inverse_right_jacobian, log
from slam_backend.core.space import SPACES
from slam_backend.io.formats import read_graph
from slam_backend.io.problem import problem_of

DATA = Path(__file__).parents[3] / "../shared/data"
SIGMAS = {"2d": [0.05, 0.05, 0.02], "3d": [0.02, 0.02, 0.02, 0.05, 0.05, 0.05]}


def edge(space, i, j, measured, kind=None):
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array(SIGMAS[space.name]))
    kind = kind or ("motion" if j - i == 1 else "loop")
    return Factor(f"edges/{i}-{j}", kind, space.between(X(i), X(j), measured, noise), (X(i), X(j)), j)


def circle(space, count=40, seed=0, first=0):
    """Noisy odometry around a circle, loops across it, and a start that has drifted."""
    rng = np.random.default_rng(seed)
    sigmas = np.array(SIGMAS[space.name])
    turn = 2 * np.pi / count
    step = space.from_extrinsics((1.0, 0.0, 0.02, 0.01, 0.0, turn))
    truth = [space.identity]
    for _ in range(count - 1):
        truth.append(truth[-1].compose(step))
    pairs = [
        *pairwise(range(count)),
        *((k, (k + count // 2) % count) for k in range(0, count // 2, 3)),
        (0, count - 1),
    ]
    edges = [
        edge(
            space,
            first + i,
            first + j,
            truth[i].between(truth[j]).compose(space.expmap(rng.normal(0, sigmas))),
        )
        for i, j in pairs
    ]
    start = gtsam.Values()
    for k, pose in enumerate(truth):
        start.insert(X(first + k), pose.compose(space.expmap(rng.normal(0, 3 * sigmas))))
    return edges, start


def apart(space, a, b, keys):
    """The largest difference in m and rad of two answers."""
    return np.max([space.size(space.pose_in(a, k).between(space.pose_in(b, k))) for k in keys], axis=0)


@pytest.fixture(params=["2d", "3d"])
def space(request):
    return SPACES[request.param]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("ordering", ["colamd", "metis"])
def test_every_method_and_ordering_ends_at_the_same_optimum(space, method, ordering):
    factors, start = circle(space)
    found = solve(factors, start, Options(method, ordering, polish=True))
    other = solve(factors, start, Options("lm", polish=True))
    assert found.stop == SMALL_STEP
    assert found.cost == pytest.approx(other.cost, rel=1e-12)
    assert (apart(space, found.values, other.values, start.keys()) < 1e-8).all()


def test_the_cost_is_that_of_the_factors_alone_and_never_rises_with_levenberg_marquardt(space):
    factors, start = circle(space)
    found = solve(factors, start)
    assert found.cost_initial == pytest.approx(cost_of(factors, start))
    assert found.cost == pytest.approx(cost_of(factors, found.values))
    costs = [found.cost_initial, *(step.cost for step in found.iterations)]
    assert costs == sorted(costs, reverse=True)
    assert found.stop in (NO_FALL, SETTLED)


def test_progress_is_told_every_iteration(space):
    factors, start = circle(space)
    told = []
    found = solve(factors, start, progress=told.append)
    assert tuple(told) == found.iterations
    assert all(step.step > 0 for step in told)


def test_the_limit_of_iterations_is_a_reason_to_stop(space):
    factors, start = circle(space)
    found = solve(factors, start, Options(iterations=1))
    assert found.stop == "iteration limit"
    assert len(found.iterations) == 1


def test_edges_that_agree_with_each_other_cost_nothing_and_end_at_once(space):
    _, start = circle(space)
    exact = [
        edge(space, i, j, space.pose_in(start, X(i)).between(space.pose_in(start, X(j))))
        for i, j in pairwise(range(40))
    ]
    found = solve(exact, start)
    assert found.cost < 1e-12
    assert found.iterations == ()


def test_every_part_that_floats_is_held_at_its_start(space):
    """Two circles that nothing connects, and a vertex that nothing touches."""
    one, start = circle(space)
    two, other = circle(space, seed=1, first=100)
    start.insert(other)
    start.insert(X(500), space.from_extrinsics((7.0, 8.0, 0, 0, 0, 0)))
    found = solve([*one, *two], start)
    assert found.gauged == (X(0), X(100))
    assert found.found.sizes() == [40, 40]
    assert found.found.idle == (X(500),)
    for key in (X(0), X(100), X(500)):
        assert max(space.size(space.pose_in(found.values, key).between(space.pose_in(start, key)))) < 1e-6
    alone = solve(one, start, Options(polish=True)).cost + solve(two, start, Options(polish=True)).cost
    assert found.cost == pytest.approx(alone, rel=1e-4)


def test_a_part_with_an_absolute_pose_needs_no_gauge(space):
    factors, start = circle(space)
    there = space.from_extrinsics((5.0, 5.0, 0, 0, 0, 1.0))
    prior = space.prior(X(3), there, gtsam.noiseModel.Isotropic.Sigma(space.dimension, 0.1))
    found = solve([*factors, Factor("priors/0", "pose", prior, (X(3),), 0)], start, Options(polish=True))
    assert found.gauged == ()
    assert max(space.size(space.pose_in(found.values, X(3)).between(there))) < 1e-9


def test_without_an_edge_there_is_nothing_to_solve():
    with pytest.raises(SolverFailure, match="no edges"):
        solve([], gtsam.Values())


def test_a_start_that_is_not_finite_is_refused():
    factors, start = circle(SPACES["2d"])
    start.update(X(5), gtsam.Pose2(np.nan, 0, 0))
    with pytest.raises(SolverFailure, match="not finite"):
        solve(factors, start)


def test_polish_meets_itself_from_two_sides(space):
    """Residuals of gtsam's planar factors are noisy to 1e-7 near zero; the polish must not be."""
    factors, start = circle(space, count=200)
    near = solve(factors, start).values
    moved = gtsam.Values()
    rng = np.random.default_rng(3)
    for key in near.keys():  # noqa: SIM118
        moved.insert(
            key, space.pose_in(near, key).compose(space.expmap(rng.normal(0, 1e-3, space.dimension)))
        )
    moved.update(X(0), space.pose_in(near, X(0)))
    one, two = polish(factors, near), polish(factors, moved)
    assert {one.stop, two.stop} == {SMALL_STEP}
    assert (apart(space, one.values, two.values, near.keys()) < 1e-8).all()


def test_polish_of_a_long_open_trajectory_is_exact():
    """The optimum of odometry alone is the odometry: two thousand poses on, not a micrometre off."""
    space = SPACES["2d"]
    rng = np.random.default_rng(4)
    steps = [gtsam.Pose2(1, 0, 0.01 * rng.normal()) for _ in range(2000)]
    truth, start = [gtsam.Pose2()], gtsam.Values()
    for step in steps:
        truth.append(truth[-1].compose(step))
    for k, pose in enumerate(truth):
        start.insert(X(k), pose.compose(gtsam.Pose2.Expmap(rng.normal(0, 1e-3, 3) * (k > 0))))
    found = polish([edge(space, k, k + 1, step) for k, step in enumerate(steps)], start)
    assert found.stop == SMALL_STEP
    assert max(space.size(found.values.atPose2(X(2000)).between(truth[-1]))) < 1e-8


def test_landmarks_and_kernels_go_through_the_polish():
    space = SPACES["2d"]
    factors, start = circle(space)
    noise = gtsam.noiseModel.Diagonal.Sigmas([0.02, 0.1])
    robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(1.345), noise)
    start.insert(L(0), np.array([2.0, 5.0]))
    for k, model in ((0, noise), (5, robust), (9, noise)):
        pose = start.atPose2(X(k))
        seen = space.observe(
            X(k), L(0), np.array([pose.bearing([2, 5]).theta() + 0.01, pose.range([2, 5])]), model
        )
        factors.append(Factor(f"seen/{k}", "landmark", seen, (X(k), L(0)), k))
    found = polish(factors, solve(factors, start).values)
    assert found.stop == SMALL_STEP
    better = gtsam.LevenbergMarquardtOptimizer(graph_of(factors, start), found.values).optimize()
    assert cost_of(factors, better) == pytest.approx(found.cost, rel=1e-9)


def graph_of(factors, start):
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor.factor)
    graph.add(gtsam.PriorFactorPose2(X(0), start.atPose2(X(0)), gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)))
    return graph


def test_the_planar_logarithm_and_its_derivative_are_those_of_gtsam():
    rng = np.random.default_rng(5)
    poses = rng.normal(0, 1, (50, 3))
    for pose, tangent, jacobian, turned in zip(
        poses, log(poses), inverse_right_jacobian(log(poses)), adjoint(poses), strict=True
    ):
        native = gtsam.Pose2(*pose)
        assert tangent == pytest.approx(gtsam.Pose2.Logmap(native), abs=1e-12)
        assert jacobian == pytest.approx(gtsam.Pose2.LogmapDerivative(gtsam.Pose2.Logmap(native)), abs=1e-9)
        assert turned == pytest.approx(native.AdjointMap(), abs=1e-12)
    a, b = poses[:25], poses[25:]
    for i, j, seen in zip(a, b, between(a, b), strict=True):
        assert gtsam.Pose2(*seen).equals(gtsam.Pose2(*i).between(gtsam.Pose2(*j)), 1e-12)


def test_planar_factors_that_measure_a_place_alone_are_polished_too():
    """Their information is singular: as fixes on poses whose heading the edges tell."""
    space, values, root = SPACES["2d"], gtsam.Values(), np.diag((10.0, 10.0, 0.0))
    place = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)
    factors = [edge(space, n, n + 1, gtsam.Pose2(1.0, 0.0, 0.3)) for n in range(6)]
    for n in range(7):
        values.insert(X(n), gtsam.Pose2(n, 0.1 * n, 0.2))
        prior = space.prior(X(n), gtsam.Pose2(n, n * n / 10, 2.0), place)
        factors.append(Factor(f"fixes/{n}", "gnss", prior, (X(n),), n))
    graph = gtsam.NonlinearFactorGraph()
    for each in factors:
        graph.add(each.factor)
    native = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    found = polish(factors, native)
    assert found.cost == pytest.approx(graph.error(native), rel=1e-5)
    assert found.cost <= graph.error(native)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-6, 1.9e-3, 2.1e-3])
def test_the_planar_logarithm_loses_nothing_near_zero(angle):
    """Against the series to the fourth power, which is exact there."""
    tangent = log(np.array([[1.0, 0.5, angle]]))[0]
    along = 1 - angle**2 / 12 - angle**4 / 720
    assert tangent == pytest.approx([along + angle / 4, along / 2 - angle / 2, angle], abs=1e-15)


OPTIMA = {  # chi2/2, the data's README
    "pgo_sesync/tinyGrid3D": 9.313909,
    "pgo_sesync/smallGrid3D": 517.9253,
    "pgo_sesync/sphere2500": 675.7007,
    "pgo_sesync/parking-garage": 0.634189,
    "pgo_sesync/CSAIL": 20.27544,
    "pgo_sesync/intel": 22.50212,
    "pgo_sesync/MIT": 20.60347,
    "pgo_sesync/city10000": 255.9937,
    "pgo_carlone2d/M3500": 68.95744,
    "pgo_carlone2d/M3500a": 456.0958,
    "pgo_carlone2d/M3500b": 1027.689,
    "pgo_carlone2d/INTEL": 107.92,
    "pgo_glc/duderstadt": 151.5016,
}


@pytest.mark.parametrize("name", OPTIMA)
@pytest.mark.skipif(not DATA.is_dir(), reason="the data lies beside the checkout")
def test_public_graphs_are_solved_to_the_optimum(name):
    """From the file's vertices or odometry; with the start chosen, nobody has to know the graph."""
    problem = problem_of(read_graph(DATA / f"{name}.g2o"))
    found = solve(problem.factors, initialize(problem.factors, problem.stated))
    assert found.cost <= 1.0005 * OPTIMA[name]
