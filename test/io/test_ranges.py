"""Ranges of a PyFG file: in the graph of `solve` and in a replay, between vertices and to landmarks, and back into a file."""

import numpy as np
import pytest

from slam_backend.cli import main
from slam_backend.core.solvers.batch import solve
from slam_backend.core.solvers.initialize import initialize
from slam_backend.io.formats import read_graph, write_graph
from slam_backend.io.optimum import Request, optimum
from slam_backend.io.problem import problem_of
from slam_backend.io.replay import replay

BEACONS = {"L0": (4.0, 9.0, 2.0), "L1": (16.0, -7.0, 3.0)}
SIGMA = 0.05  # m, of a range
NEAR = 1.0  # m, to which odometry and ranges tell a beacon 17 m off; its mirror image is 15 m away


def walk(space, seed=2, poses=25):
    """A winding path, up and down in space: (truth (N, 3), headings (N,), lines of the file without landmarks' positions)."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(np.r_[0, 0.5 * np.sin(np.arange(poses - 1) / 3)])
    step = np.stack(
        [np.cos(heading), np.sin(heading), 0.6 * np.cos(np.arange(poses) / 4) * (space == "3d")], axis=1
    )
    truth = np.cumsum(np.vstack([np.zeros(3), step[:-1]]), axis=0)
    beacons = {name: np.array(at) * (1, 1, space == "3d") for name, at in BEACONS.items()}
    lines = []
    for k in range(poses - 1):
        forward, up = 1 + rng.normal(0, 0.05), step[k, 2] + rng.normal(0, 0.05)
        turn = heading[k + 1] - heading[k] + rng.normal(0, 0.02)
        if space == "2d":
            lines.append(
                f"EDGE_SE2 {k + 1}. A{k} A{k + 1} {forward:.17g} {rng.normal(0, 0.05):.17g} {turn:.17g} .0025 0 0 .0025 0 .0004"
            )
        else:
            noise = " ".join(
                f"{(0.0025 if r < 3 else 0.0004) * (r == c)}" for r in range(6) for c in range(r, 6)
            )
            at = f"{forward:.17g} {rng.normal(0, 0.05):.17g} {up:.17g} 0 0 {np.sin(turn / 2):.17g} {np.cos(turn / 2):.17g}"
            lines.append(f"EDGE_SE3:QUAT {k + 1}. A{k} A{k + 1} {at} {noise}")
        for name, at in beacons.items():
            distance = np.linalg.norm(at - truth[k]) + rng.normal(0, SIGMA)
            lines.append(f"EDGE_RANGE {k}. A{k} {name} {distance:.17g} {SIGMA**2:.17g}")
    apart = np.linalg.norm(truth[poses - 1] - truth[3]) + rng.normal(0, SIGMA)
    lines.append(f"EDGE_RANGE {poses - 1}. A{poses - 1} A3 {apart:.17g} {SIGMA**2:.17g}")
    return truth, beacons, lines


@pytest.fixture(params=["2d", "3d"])
def graph(request, tmp_path):
    """(path, truth, beacons) of a file that states no vertex, and landmarks where they are not."""
    truth, beacons, lines = walk(request.param)
    names = [
        f"VERTEX_XY {name} 99 99" if request.param == "2d" else f"VERTEX_XYZ {name} 99 99 99"
        for name in beacons
    ]
    path = tmp_path / "walk.pyfg"
    path.write_text("\n".join([*names, *lines]) + "\n")
    return path, truth, beacons


def test_every_range_is_a_factor_with_the_noise_of_the_file(graph):
    problem = problem_of(read_graph(graph[0]))
    ranges = [f for f in problem.factors if f.kind in ("landmark", "range")]
    assert [f.kind for f in ranges].count("range") == 1
    assert len(ranges) == 49
    assert {type(f.factor).__name__[:11] for f in ranges} == {"RangeFactor"}
    np.testing.assert_allclose([f.factor.noiseModel().sigmas()[0] for f in ranges], SIGMA)
    assert not problem.decisions
    assert not problem.left_out


def test_landmarks_that_nothing_places_but_ranges_are_found(graph):
    """From odometry alone: the path fits better than the odometry does, and the beacons are where they are."""
    path, truth, beacons = graph
    problem = problem_of(read_graph(path))
    problem.stated.clear()
    start = initialize(problem.factors, problem.stated, "odometry")
    solution = solve(problem.factors, start)
    found = problem.solved(solution.values)
    for at, expected in zip(found.positions, beacons.values(), strict=True):
        assert np.linalg.norm(at - expected[: len(at)]) < NEAR
    first, last = beacons.values()
    apart = np.linalg.norm(np.subtract(*found.positions)), np.linalg.norm(first - last)
    assert abs(apart[0] - apart[1]) < 0.5
    assert np.linalg.norm(found.poses[-1, :3] - found.poses[3, :3]) == pytest.approx(
        np.linalg.norm(truth[-1] - truth[3]), abs=3 * SIGMA
    )
    free = sum(f.factor.dim() for f in problem.factors) - start.values.dim() + problem.space.dimension
    assert 2 * solution.cost < free + 3.3 * np.sqrt(2 * free)  # 99.9 %


def test_a_solved_graph_survives_the_file_to_the_bit(graph, tmp_path):
    problem = problem_of(read_graph(graph[0]))
    found = problem.solved(optimum(problem, Request(), lambda _: None).solution.values)
    out = tmp_path / "out.pyfg"
    write_graph(out, found)
    again = read_graph(out)
    for name in ("i", "j", "to_landmark", "ranges", "variances"):
        np.testing.assert_array_equal(getattr(again.ranges, name), getattr(found.ranges, name))
    np.testing.assert_array_equal(again.positions, found.positions)
    np.testing.assert_array_equal(again.states, found.states)


def test_a_replay_and_isam2_use_them_too(graph, capsys):
    """A landmark that waits for its place: it enters the graph of a replay with all that waited."""
    path, _, beacons = graph
    result = replay(path).result
    assert sum(f.kind == "landmark" for f in result.factors) == 48
    for name, at in zip(result.snapshot.names, result.snapshot.landmarks, strict=True):
        assert np.linalg.norm(at - beacons[name]) < NEAR
    assert any("left out: 1 ranges between vertices" in line for line in result.summary["damage"])
    assert main(["solve", str(path), "--method", "isam2"]) == 0
    assert "not used: 1 ranges between vertices (isam2 goes" in capsys.readouterr().out
    for takes_them in (["--method", "isam2", "--polish"], []):
        assert main(["solve", str(path), *takes_them]) == 0
        assert "not used" not in capsys.readouterr().out


def test_priors_that_a_replay_does_not_take_are_told(tmp_path, capsys):
    """Of vertices and landmarks; each in one line, with what takes it."""
    _, _, lines = walk("2d")
    path = tmp_path / "held.pyfg"
    priors = ["VERTEX_SE2:PRIOR 0 A0 0 0 0 .01 0 0 .01 0 .01", "VERTEX_XY:PRIOR 0 L1 9 9 .01 0 .01"]
    path.write_text("\n".join([*lines, *priors]) + "\n")
    damage = "\n".join(replay(path).result.summary["damage"])
    assert "left out: 1 priors of vertices" in damage
    assert "left out: 1 priors of landmarks" in damage
    assert main(["solve", str(path), "--method", "isam2"]) == 0
    out = capsys.readouterr().out
    assert "1 priors of vertices (isam2 goes" in out
    assert out.count("priors of landmarks") == 1


def test_one_range_places_nothing_and_stops_nothing(tmp_path):
    path = tmp_path / "one.pyfg"
    path.write_text(
        "VERTEX_SE2 0. A0 0 0 0\nVERTEX_SE2 1. A1 1 0 0\nVERTEX_XY L0 3 4\n"
        "EDGE_SE2 1. A0 A1 1 0 0 .01 0 0 .01 0 .01\nEDGE_RANGE 1. A1 L0 4.5 .01\n"
    )
    problem = problem_of(read_graph(path))
    for method in ("lm", "isam2"):
        assert optimum(problem, Request(method), lambda _: None).solution.cost < 1e-6
