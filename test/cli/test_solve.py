"""`slam-backend solve`: what it prints, what it writes, and the one line when it cannot."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest

from slam_backend import cli
from slam_backend.cli.solve import command
from slam_backend.core.config import KernelName
from slam_backend.core.solvers.descent import METHODS
from slam_backend.io.formats import read_graph, read_trajectory

ROOT = Path(__file__).parents[2]
DATA = ROOT / "../shared/data"
KEYS = {"vertices", "edges", "cost_initial", "cost", "iterations", "seconds", "method"}
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the data lies beside the checkout")
WEIGHT = "100 0 0 100 0 400"


@pytest.fixture
def square(tmp_path):
    """Twice around a square with drift, the second time known to be in the same places; vertex 99 hangs in the air."""
    path = tmp_path / "square.g2o"
    rng = np.random.default_rng(0)
    corners = [(0, 0, 0), (1, 0, 0), (2, 0, 1), (2, 1, 1), (2, 2, 2), (1, 2, 2), (0, 2, 3), (0, 1, 3)] * 2
    lines = [f"VERTEX_SE2 {k} {x} {y} {q * np.pi / 2}" for k, (x, y, q) in enumerate(corners)]
    lines.append("VERTEX_SE2 99 5 5 0")
    for k in range(15):
        a, b, c = rng.normal(0, 0.05, 3)
        lines.append(f"EDGE_SE2 {k} {k + 1} {1 + a} {b} {np.pi / 2 * (k % 2) + c} {WEIGHT}")
    lines += [f"EDGE_SE2 {k} {k + 8} 0 0 0 {WEIGHT}" for k in range(8)]
    path.write_text("\n".join(lines) + "\n")
    return path


def solve(capsys, *arguments):
    code = cli.main(["solve", *map(str, arguments)])
    out, err = capsys.readouterr()
    return code, out, err


def test_one_line_says_what_was_done(square, capsys):
    code, out, _ = solve(capsys, square)
    assert code == 0
    first, *more = out.splitlines()
    assert "17 vertices, 23 edges; cost " in first
    assert "chi2/2" in first
    assert "iterations of lm" in first
    assert first.endswith(("cost no longer falls", "each fall a small part of the last"))
    assert any("no edge touches them: 99" in line for line in more)


@pytest.mark.parametrize("method", [*METHODS, "isam2"])
def test_json_has_the_promised_keys_and_every_method_the_same_answer(square, capsys, method):
    code, out, _ = solve(capsys, square, "--method", method, "--polish", "--json")
    said = json.loads(out)
    assert code == 0
    assert said.keys() >= KEYS
    assert said["method"] == method
    assert said["cost"] < said["cost_initial"]
    best = json.loads(solve(capsys, square, "--polish", "--json")[1])["cost"]
    assert said["cost"] == pytest.approx(best, rel=1e-9)


def test_steps_tell_cost_step_damping_and_seconds(square, capsys):
    said = json.loads(solve(capsys, square, "--json")[1])
    assert len(said["steps"]) == said["iterations"]
    assert all(step.keys() == {"cost", "step", "damping", "seconds"} for step in said["steps"])
    assert said["steps"][-1]["cost"] == pytest.approx(said["cost"])


@pytest.mark.parametrize("name", ["solved.g2o", "solved.graph", "solved.pyfg"])
def test_the_solved_graph_starts_at_its_optimum(square, capsys, tmp_path, name):
    out = tmp_path / name
    said = json.loads(solve(capsys, square, "--out", out, "--polish", "--json")[1])
    again = json.loads(solve(capsys, out, "--init", "file", "--json")[1])
    assert again["cost_initial"] == pytest.approx(said["cost"], rel=1e-6)
    assert again["edges"] == said["edges"]


def test_the_edges_of_the_solved_graph_are_those_of_the_input_to_the_bit(square, capsys, tmp_path):
    solve(capsys, square, "--out", tmp_path / "solved.g2o")
    before, after = read_graph(square), read_graph(tmp_path / "solved.g2o")
    assert np.array_equal(before.edges.states, after.edges.states)
    assert np.array_equal(before.edges.information, after.edges.information)


def test_the_trajectory_is_written_where_the_extension_says_so(square, capsys, tmp_path):
    assert solve(capsys, square, "--out", tmp_path / "solved.tum")[0] == 0
    assert len(read_trajectory(tmp_path / "solved.tum").stamps) == 17


def test_a_wrong_loop_is_named_by_gnc_and_weighed_down_by_a_kernel(square, capsys):
    with square.open("a") as file:
        file.write(f"EDGE_SE2 2 13 9 9 1 {WEIGHT}\n")
    plain = json.loads(solve(capsys, square, "--json")[1])
    judged = json.loads(solve(capsys, square, "--robust", "gnc", "--json")[1])
    robust = json.loads(solve(capsys, square, "--robust", "cauchy", "--json")[1])
    assert judged["refused"] == [["2", "13"]]
    assert judged["cost"] < plain["cost"] / 10
    assert robust["cost"] < plain["cost"] / 10
    assert "wrong loops: 2-13" in solve(capsys, square, "--robust", "gnc")[1]


def test_an_interrupt_ends_the_judging_of_loops_within_a_second(tmp_path):
    """Sent as soon as it works, to a graph that takes many seconds."""
    path, rng = tmp_path / "long.g2o", np.random.default_rng(0)
    lines = [f"EDGE_SE2 {k} {k + 1} 1 0 0.01 {WEIGHT}" for k in range(8_000)]
    lines += [
        f"EDGE_SE2 {i} {j} 0 0 0 {WEIGHT}" for i, j in rng.integers(8_000, size=(300, 2)) if abs(i - j) > 1
    ]
    path.write_text("\n".join(lines) + "\n")
    source = (
        "import sys; from slam_backend import cli; from slam_backend.core.solvers import gnc\n"
        "class Told(gnc.Graduation):\n"
        "    def advance(self): print('judging', flush=True); return super().advance()\n"
        "gnc.Graduation = Told; sys.exit(cli.main(sys.argv[1:]))\n"
    )
    command = [sys.executable, "-c", source, "solve", str(path), "--robust", "gnc"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "judging\n"
        begin = time.monotonic()
        process.send_signal(signal.SIGINT)
        error = process.communicate(timeout=60)[1]
    assert (process.returncode, error) == (130, "slam-backend: interrupted\n")
    assert time.monotonic() - begin < 3.0, "a second, on a machine that does other things as well"


def test_the_kernels_on_offer_are_those_of_the_configuration():
    offered = get_args(get_type_hints(command)["robust"])
    assert set(offered) == {*get_args(KernelName), "gnc"}


@needs_data
def test_the_convention_of_3d_rotation_information_is_said_and_counts(capsys):
    graph = DATA / "pgo_sesync/tinyGrid3D.g2o"
    costs = {}
    for convention in ("gtsam", "g2o"):
        out = solve(capsys, graph, "--rotation-information", convention)[1]
        assert f"rotation information as {convention} means it" in out.splitlines()[0]
        costs[convention] = json.loads(
            solve(capsys, graph, "--rotation-information", convention, "--json")[1]
        )["cost"]
    assert costs["gtsam"] == pytest.approx(9.313909, rel=5e-4)
    assert costs["g2o"] < costs["gtsam"]


@needs_data
@pytest.mark.parametrize("name", ["tinyGrid3D", "smallGrid3D"])
def test_isam2_ends_where_batch_does(capsys, name):
    graph = DATA / f"pgo_sesync/{name}.g2o"
    online = json.loads(solve(capsys, graph, "--method", "isam2", "--json")[1])
    batch = json.loads(solve(capsys, graph, "--json")[1])
    assert online["cost"] == pytest.approx(batch["cost"], rel=1e-4)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["{}/nothing.g2o"], "nothing.g2o"),
        (["{}/square.g2o", "--out", "{}/solved.xyz"], "end it in"),
        (["{}/square.g2o", "--method", "newton"], "newton"),
        (["{}/vertices.g2o"], "no edges"),
        (["{}/edges.g2o", "--init", "file"], "states no vertices"),
    ],
)
def test_what_the_user_can_mend_is_one_line(square, tmp_path, capsys, arguments, line):
    lines = square.read_text().splitlines()
    (tmp_path / "vertices.g2o").write_text("\n".join(each for each in lines if each.startswith("VERTEX")))
    (tmp_path / "edges.g2o").write_text("\n".join(each for each in lines if each.startswith("EDGE")))
    code, out, err = solve(capsys, *(each.format(tmp_path) for each in arguments))
    assert code == 2
    assert out == ""
    assert len(err.splitlines()) == 1
    assert line in err
