"""A graph file as a problem: the same factors that a replay makes, its ids, its held vertices."""

from pathlib import Path

import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from slam_backend.core.solvers.batch import solve
from slam_backend.core.solvers.initialize import cost_of, initialize
from slam_backend.io.formats import read_graph
from slam_backend.io.problem import odometry_edges, problem_of
from slam_backend.io.replay import replay

DATA = Path(__file__).parents[2] / "../shared/data"
WEIGHT = "100 0 0 100 0 400"


def written(tmp_path, *lines):
    path = tmp_path / "graph.g2o"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.skipif(not DATA.is_dir(), reason="the data lies beside the checkout")
@pytest.mark.parametrize("name", ["tinyGrid3D", "smallGrid3D"])
def test_the_factors_are_those_of_a_replay(name):
    """The same ends, measurements and noise to the bit; only the gauge is added by whoever solves."""
    path = DATA / f"pgo_sesync/{name}.g2o"
    problem = problem_of(read_graph(path))
    replayed = [
        factor for factor in replay(path, settings=["robust=[]"]).result.factors if factor.kind != "gauge"
    ]
    assert len(problem.factors) == len(replayed)
    ours = {factor.stamps: factor.factor for factor in problem.factors}
    for factor in replayed:
        same = ours[factor.stamps]
        assert factor.factor.measured().equals(same.measured(), 0)
        assert np.array_equal(factor.factor.noiseModel().R(), same.noiseModel().R())


def test_odometry_is_between_consecutive_vertices_of_one_robot(tmp_path):
    a, b = ord("a") << 56, ord("b") << 56
    pairs = [(a, a + 1), (a + 1, a + 2), (b, b + 1), (a + 2, b), (a, a + 2), (b + 1, a + 1)]
    graph = read_graph(written(tmp_path, *(f"EDGE_SE2 {i} {j} 1 0 0 {WEIGHT}" for i, j in pairs)))
    assert odometry_edges(graph) == {(0, 1), (1, 2), (3, 4)}


def test_a_vertex_without_odometry_hangs_on_its_first_edge_to_an_older_one(tmp_path):
    pairs = [(0, 1), (0, 2), (2, 3), (1, 3)]
    graph = read_graph(written(tmp_path, *(f"EDGE_SE2 {i} {j} 1 0 0 {WEIGHT}" for i, j in pairs)))
    assert odometry_edges(graph) == {(0, 1), (0, 2), (2, 3)}


def test_landmarks_are_solved_with_the_poses_and_come_back_under_their_ids(tmp_path):
    path = written(
        tmp_path,
        "VERTEX_SE2 5 0 0 0",
        "VERTEX_SE2 6 1.1 0 0",
        "VERTEX_XY 3 9 9",
        f"EDGE_SE2 5 6 1 0 0 {WEIGHT}",
        "EDGE_SE2_XY 5 3 2 1 100 0 100",
        "EDGE_SE2_XY 6 3 1 1 100 0 100",
    )
    problem = problem_of(read_graph(path))
    found = solve(problem.factors, initialize(problem.factors, problem.stated, "file"))
    solved = problem.solved(found.values)
    assert found.cost < 1e-6
    assert solved.positions[0] == pytest.approx([2, 1], abs=1e-3)
    assert solved.states[1] == pytest.approx([1, 0, 0], abs=1e-3)
    assert problem.name(X(1)) == "6"
    assert problem.name(L(0)) == "landmark 3"


def test_vertices_that_the_file_holds_do_not_move(tmp_path):
    path = written(
        tmp_path,
        "VERTEX_SE2 0 0 0 0",
        "VERTEX_SE2 1 1 0 0",
        "VERTEX_SE2 2 3 0 0",
        "FIX 0",
        "FIX 2",
        f"EDGE_SE2 0 1 1 0 0 {WEIGHT}",
        f"EDGE_SE2 1 2 1 0 0 {WEIGHT}",
    )
    problem = problem_of(read_graph(path))
    for how in ("file", "odometry"):
        found = solve(problem.factors, initialize(problem.factors, problem.stated, how))
        solved = problem.solved(found.values)
        assert found.gauged == ()
        assert solved.states[0] == pytest.approx([0, 0, 0], abs=1e-9)
        assert solved.states[1] == pytest.approx([1.5, 0, 0], abs=1e-6)
        assert solved.states[2] == pytest.approx([3, 0, 0], abs=1e-9)
        assert found.cost == pytest.approx(
            2 * 0.5 * 100 * 0.5**2
        )  # the strain of the edges, and nothing else


def test_what_the_firewall_refuses_is_told_and_not_solved(tmp_path):
    path = written(
        tmp_path,
        f"EDGE_SE2 0 1 1 0 0 {WEIGHT}",
        f"EDGE_SE2 1 2 1 0 0 {WEIGHT}",
        f"EDGE_SE2 0 2 1e12 0 0 {WEIGHT}",
    )
    problem = problem_of(read_graph(path))
    assert [decision.verdict for decision in problem.decisions] == ["refused"]
    found = solve(problem.factors, initialize(problem.factors, problem.stated))
    assert cost_of(problem.factors, found.values) < 1e-9
