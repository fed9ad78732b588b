"""Where a descent starts: what the file states, the odometry, or rotations first; and which of them is chosen when."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from slam_backend.core.errors import BadConfig, SolverFailure
from slam_backend.core.graph import Factor
from slam_backend.core.solvers.batch import solve
from slam_backend.core.solvers.initialize import cost_of, initialize
from slam_backend.core.space import SPACES
from slam_backend.io.formats import read_graph
from slam_backend.io.problem import problem_of

DATA = Path(__file__).parents[3] / "../shared/data"


@pytest.fixture(params=["2d", "3d"])
def space(request):
    return SPACES[request.param]


def edge(space, i, j, measured, kind="motion", sigma=0.1):
    noise = gtsam.noiseModel.Isotropic.Sigma(space.dimension, sigma)
    return Factor(f"edges/{i}-{j}/{kind}", kind, space.between(X(i), X(j), measured, noise), (X(i), X(j)), j)


def spiral(space, count=200, drift=0.0):
    """Truth, and edges that are exact but for a constant drift of the odometry's turns."""
    step = space.from_extrinsics((1.0, 0.1, 0.05, 0.02, 0.0, 0.3))
    bent = step.compose(space.from_extrinsics((0, 0, 0, 0, 0, drift)))
    truth = [space.from_extrinsics((3.0, 4.0, 0, 0, 0, 0.5))]
    for _ in range(count - 1):
        truth.append(truth[-1].compose(step))
    edges = [edge(space, k, k + 1, bent) for k in range(count - 1)]
    edges += [
        edge(space, k, k + 21, truth[k].between(truth[k + 21]), "loop", 0.02) for k in range(0, count - 21, 3)
    ]
    return truth, edges


def stated(poses):
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(X(k), pose)
    return values


@pytest.mark.parametrize("how", ["odometry", "chordal"])
def test_without_noise_every_start_is_the_answer(space, how):
    truth, edges = spiral(space)
    start = initialize(edges, stated(truth[:1]), how)
    assert start.name == how
    assert cost_of(edges, start.values) < 1e-12
    for k, pose in enumerate(truth):
        assert max(space.size(space.pose_in(start.values, X(k)).between(pose))) < 1e-6


def test_without_vertices_the_first_pose_is_the_origin(space):
    _, edges = spiral(space)
    values = initialize(edges, None, "odometry").values
    assert max(space.size(space.pose_in(values, X(0)))) == 0


def test_the_file_serves_when_no_edge_is_far_from_it(space):
    truth, edges = spiral(space)
    start = initialize(edges, stated(truth))
    assert start.name == "file"
    assert "no edge disagrees" in start.why


def test_a_file_that_is_wound_is_left_for_an_odometry_that_is_not(space):
    """Every other vertex of the file looks backwards."""
    truth, edges = spiral(space)
    back = space.from_extrinsics((0, 0, 0, 0, 0, 3.0))
    wound = [pose.compose(back) if k % 2 else pose for k, pose in enumerate(truth)]
    assert initialize(edges, stated(wound)).name == "odometry"


def test_a_file_that_is_wound_a_little_at_every_step_is_left_as_well(space):
    """Two whole turns too many, spread so that no edge is more than 0.7 rad off."""
    one = space.from_extrinsics((1.0, 0, 0, 0, 0, 0.1))
    edges = [edge(space, k, k + 1, one) for k in range(18)]
    wound = stated([space.from_extrinsics((0, 0, 0, 0, 0, 0.8 * k)) for k in range(19)])
    assert initialize(edges, wound).name == "odometry"


def test_trajectories_that_only_landmarks_join_start_each_at_its_own_vertex():
    space = SPACES["2d"]
    truth, edges = spiral(space, count=6)
    apart = [factor for factor in edges if factor.keys != (X(2), X(3))]
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 0.1)
    seen = [
        Factor(f"seen/{k}", "landmark", space.observe(X(k), L(0), np.array([0.3, 4.0]), noise), (X(k), L(0)), 0) for k in (1, 4)
    ]  # fmt: skip
    for how in ("odometry", "chordal"):
        values = initialize([*apart, *seen], stated(truth), how).values
        assert max(space.size(values.atPose2(X(4)).between(truth[4]))) < 1e-6


def test_odometry_goes_along_consecutive_edges_and_over_as_few_others_as_it_can(space):
    """A gap in the odometry between 4 and 5, and two loops over it; the wrong one would take two loops."""
    one = space.from_extrinsics((1.0, 0, 0, 0, 0, 0))
    ten = space.from_extrinsics((10.0, 0, 0, 0, 0, 0))
    edges = [edge(space, k, k + 1, one) for k in (0, 1, 2, 3, 5, 6, 7)]
    edges += [edge(space, 2, 6, ten, "loop"), edge(space, 0, 2, ten, "loop")]
    values = initialize(edges, None, "odometry").values
    along = [round(float(space.seven(space.pose_in(values, X(k)))[0])) for k in range(9 - 1)]
    assert along == [0, 1, 2, 3, 4, 11, 12, 13]


def test_rotations_first_unwinds_what_drift_has_wound(space):
    """Half a turn of drift between the ends of every loop: odometry is no start, the relaxation is."""
    _, edges = spiral(space, drift=0.15)
    wound = initialize(edges, None, "odometry")
    unwound = initialize(edges, None, "chordal")
    assert cost_of(edges, unwound.values) < cost_of(edges, wound.values) / 100
    chosen = initialize(edges, None)
    assert solve(edges, chosen).cost == pytest.approx(solve(edges, unwound).cost, rel=1e-3)


def test_parts_start_each_at_its_own_vertex_or_prior(space):
    _, edges = spiral(space, count=30)
    other = [
        Factor(f"more/{n}", f.kind, space.between(f.keys[0] + 100, f.keys[1] + 100, f.factor.measured(), f.factor.noiseModel()),
               (f.keys[0] + 100, f.keys[1] + 100), 0)
        for n, f in enumerate(edges)
    ]  # fmt: skip
    there = space.from_extrinsics((50.0, 0, 0, 0, 0, 0))
    prior = space.prior(X(103), there, gtsam.noiseModel.Isotropic.Sigma(space.dimension, 0.1))
    factors = [*edges, *other, Factor("priors/0", "pose", prior, (X(103),), 0)]
    for how in ("odometry", "chordal"):
        values = initialize(factors, None, how).values
        assert max(space.size(space.pose_in(values, X(0)))) < 1e-6
        assert max(space.size(space.pose_in(values, X(103)).between(there))) < 1e-6
        assert cost_of(factors, values) < 1e-9


def test_landmarks_start_where_they_are_first_seen(space):
    truth, edges = spiral(space, count=5)
    point = np.array([6.0, 7.0, 1.0])[: space.point_dimension]
    local = truth[2].transformTo(point)
    value, _ = space.to_polar(local, np.eye(space.point_dimension))
    noise = gtsam.noiseModel.Isotropic.Sigma(space.point_dimension, 0.1)
    seen = Factor("seen/0", "landmark", space.observe(X(2), L(0), value, noise), (X(2), L(0)), 0)
    values = initialize([*edges, seen], stated(truth[:1]), "odometry").values
    assert space.point_in(values, L(0)) == pytest.approx(point, abs=1e-9)


def test_a_landmark_without_a_range_and_a_place_is_named():
    space = SPACES["2d"]
    _, edges = spiral(space, count=5)
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.1)
    seen = Factor(
        "b/0", "pixels", space.observe_bearing(X(2), L(0), np.array([0.1, 0]), noise), (X(2), L(0)), 0
    )
    with pytest.raises(SolverFailure, match="l0"):
        initialize([*edges, seen], None, "odometry")


def test_a_file_without_vertices_cannot_be_the_start(space):
    _, edges = spiral(space)
    with pytest.raises(BadConfig, match="states no vertices"):
        initialize(edges, None, "file")


@pytest.mark.parametrize("name", ["pgo_sesync/MIT", "pgo_carlone2d/M3500a", "pgo_carlone2d/M3500b"])
@pytest.mark.skipif(not DATA.is_dir(), reason="the data lies beside the checkout")
def test_where_the_file_ends_in_a_local_minimum_rotations_first_are_chosen(name):
    problem = problem_of(read_graph(DATA / f"{name}.g2o"))
    assert initialize(problem.factors, problem.stated).name == "chordal"
