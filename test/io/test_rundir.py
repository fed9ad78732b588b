"""The run directory: what a run leaves behind can be read back, and says the same."""

import csv
import json

import gtsam
import numpy as np
import pytest

from slam_backend.core.config import config_hash
from slam_backend.core.errors import BadFile
from slam_backend.io.configfile import load_config
from slam_backend.io.formats import read_graph, read_trajectory
from slam_backend.io.replay import replay
from slam_backend.io.result import cost
from slam_backend.io.rundir import FILES, prepare, write_run
from slam_backend.lab.simulate import Options, simulate, write_simulation

KEYS = {
    "input", "run_hash", "config_hash", "seed", "counts", "decisions", "cost", "timing", "memory_mb", "versions",
}  # fmt: skip
COUNTS = {
    "records", "measurements", "keyframes", "landmarks", "factors",
    "loops_offered", "loops_accepted", "loops_probation", "loops_refused",
}  # fmt: skip
OPTIONS = {
    "square": Options(poses=300, loop_rate=0.3, landmarks=30),
    "spiral": Options(poses=300, loop_rate=0.3, landmarks=30),
}


@pytest.fixture(scope="module", params=OPTIONS)
def run(request, tmp_path_factory):
    """A finished run in the plane and one in space, with landmarks and loops, and its directory."""
    folder = tmp_path_factory.mktemp(request.param)
    written = write_simulation(simulate(request.param, 3, OPTIONS[request.param]), folder / "drive.mcap")
    result = replay(written.bag, load_config(written.config), ["loops.kernel=cauchy"]).result
    write_run(result, folder / "run")
    return result, folder / "run"


def test_every_file_of_the_interface_is_there(run):
    _, out = run
    assert {path.name for path in out.iterdir()} == set(FILES)


def test_the_summary_has_every_key(run):
    result, out = run
    summary = json.loads((out / "summary.json").read_text())
    assert set(summary) >= KEYS
    assert set(summary["counts"]) >= COUNTS
    assert set(summary["cost"]) == {"initial", "online", "final"}
    assert set(summary["timing"]) == {"wall_s", "read_s", "solve_s", "update_ms"}
    assert set(summary["timing"]["update_ms"]) == {"p50", "p95", "p99", "max"}
    assert summary["run_hash"] == result.summary["run_hash"]
    assert summary["config_hash"] == config_hash(result.run.config)
    counts = summary["counts"]
    assert counts["keyframes"] == len(result.trajectory)
    assert counts["landmarks"] == len(result.snapshot.names)
    assert counts["loops_offered"] == counts["loops_accepted"] + counts["loops_refused"] > 10
    assert summary["cost"]["final"] <= summary["cost"]["online"] <= summary["cost"]["initial"]


@pytest.mark.parametrize("name", ["trajectory", "online", "odometry"])
def test_trajectories_read_back_to_the_bit(run, name):
    result, out = run
    mine = {
        "trajectory": result.trajectory, "online": result.run.online, "odometry": result.snapshot.odometry,
    }[name]  # fmt: skip
    back = read_trajectory(out / f"{name}.tum")
    assert back.stamps.tolist() == mine.stamps.tolist()
    np.testing.assert_array_equal(back.sevens, mine.sevens)
    if name == "odometry":
        np.testing.assert_allclose(mine.sevens[0], result.trajectory.sevens[0], atol=1e-9)


def test_the_written_configuration_replays_to_the_same_hash(run):
    result, out = run
    again = replay(result.run.inputs.paths, load_config(out / "config.yaml")).result
    assert again.summary["run_hash"] == result.summary["run_hash"]
    assert again.summary["config_hash"] == result.summary["config_hash"]


def test_every_loop_has_a_line_with_its_two_stamps(run):
    result, out = run
    lines = [json.loads(line) for line in (out / "decisions.jsonl").read_text().splitlines()]
    for line in lines:
        assert {"stamp", "id", "source", "verdict", "stage", "reason", "statistic", "threshold"} <= set(line)
        assert line["verdict"] in {"accepted", "probation", "refused", "removed", "restored"}
    loops = {line["id"]: line for line in lines if line["source"] == "loops"}
    assert len(loops) == result.summary["counts"]["loops_offered"]
    for line in loops.values():
        assert {"a", "b"} <= set(line)
        seconds, _, nanoseconds = line["a"].partition(".")
        assert seconds.isdigit()
        assert len(nanoseconds) == 9


def test_landmarks_are_rows_with_position_covariance_and_observations(run):
    result, out = run
    rows = list(csv.DictReader((out / "landmarks.csv").open()))
    assert [row["id"] for row in rows] == list(result.snapshot.names)
    found = [[float(row[axis]) for axis in "xyz"] for row in rows]
    np.testing.assert_array_equal(found, result.snapshot.landmarks)
    assert all(float(row["cov_xx"]) > 0 for row in rows)
    sightings = sum(factor.kind == "landmark" for factor in result.factors)
    assert sum(int(row["observations"]) for row in rows) == sightings


def test_the_graph_read_again_and_solved_has_the_same_cost(run):
    """The kernel is not in the file: both costs are compared without it."""
    result, out = run
    graph = read_graph(out / "graph.g2o")
    again = replay(out / "graph.g2o").result
    assert len(graph.ids) == len(result.trajectory)
    assert len(again.factors) == len(result.factors)
    plain = gtsam.NonlinearFactorGraph()
    for factor in result.factors:
        noise = factor.factor.noiseModel()
        plain.add(
            factor.factor.cloneWithNewNoiseModel(noise.noise()) if hasattr(noise, "noise") else factor.factor
        )
    solved = gtsam.LevenbergMarquardtOptimizer(plain, result.values).optimize()
    expected = sum(plain.at(i).error(solved) for i in range(plain.size()))
    assert cost(again.factors, again.values) == pytest.approx(expected, rel=1e-6)


def test_a_graph_names_its_vertices_in_decisions_and_keeps_their_ids(tmp_path):
    path = tmp_path / "graph.g2o"
    vertices = [f"VERTEX_SE2 {n} {n / 10} 0 0" for n in (10, 20, 30, 40)]
    information = "1 0 0 1 0 1"
    edges = [
        f"EDGE_SE2 {a} {b} {(b - a) / 10} 0 0 {information}"
        for a, b in ((10, 20), (20, 30), (30, 40), (10, 40))
    ]
    path.write_text("\n".join([*vertices, *edges]) + "\n")
    write_run(replay(path).result, tmp_path / "run")
    (line,) = [json.loads(line) for line in (tmp_path / "run/decisions.jsonl").read_text().splitlines()]
    assert line["vertices"] == [10, 40]
    assert read_graph(tmp_path / "run/graph.g2o").ids.tolist() == [10, 20, 30, 40]


def test_an_earlier_run_is_replaced_and_anything_else_is_refused(run, tmp_path):
    result, _ = run
    write_run(result, tmp_path / "run")
    write_run(result, tmp_path / "run")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.tex").write_text("years")
    with pytest.raises(BadFile, match=f"{tmp_path}/mine: holds other files and no earlier run"):
        write_run(result, tmp_path / "mine")
    (tmp_path / "file").write_text("")
    with pytest.raises(BadFile, match="file: is a file"):
        prepare(tmp_path / "file")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.tex"]
