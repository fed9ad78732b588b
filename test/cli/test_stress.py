"""`slam-backend stress`: wrong loops put into a recorded run, by strategy; where its map breaks, in a table and a sentence."""

import json

import numpy as np
import pytest

from slam_backend import cli
from slam_backend.core.config import config_from
from slam_backend.io.finished import FinishedRun
from slam_backend.io.replay import replay
from slam_backend.io.rundir import write_run
from slam_backend.lab.stress import Stress, sentences

ROUND = 50
PAIRS = [(k + ROUND, k) for k in range(5, 45, 4)]


def written(path, pairs):
    """Twice around a ring of fifty metres, with loops from round to round."""
    rng = np.random.default_rng(2)
    turn, weight = 2 * np.pi / ROUND, "2500 0 0 2500 0 10000"
    steps = [(k, k + 1, 1.0, 0.0, turn) for k in range(2 * ROUND - 1)]
    loops = [(i, j, 0.0, 0.0, 0.0) for i, j in pairs]
    lines = []
    for i, j, *pose in (*steps, *loops):
        x, y, t = np.array(pose) + rng.normal(0, (0.02, 0.02, 0.01))
        lines.append(f"EDGE_SE2 {i} {j} {x} {y} {t} {weight}\n")
    path.write_text("".join(lines))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    written(folder / "ring.g2o", PAIRS)
    config = config_from({"space": "2d", "sources": ["edges"], "edges": {"kind": "relative"}, "robust": []})
    write_run(replay(folder / "ring.g2o", config).result, folder / "run")
    return folder / "run"


def stressed(capsys, *arguments):
    code = cli.main(["stress", *map(str, arguments)])
    out, err = capsys.readouterr()
    return code, out, err


def test_it_says_where_each_strategy_breaks(recorded, capsys):
    names = ("--strategy", "none", "--strategy", "gnc")
    code, out, _ = stressed(capsys, recorded, "--wrong-loops", "0,30", *names)
    assert code == 0
    head, *rows = out.splitlines()
    assert head.split()[:2] == ["strategy", "wrong"]
    assert [row.split()[:2] for row in rows[:4]] == [
        ["none", "0%"],
        ["none", "30%"],
        ["gnc", "0%"],
        ["gnc", "30%"],
    ]
    assert any(
        row.startswith("none: holds to 0%, breaks at 30%: ") and "4 wrong loops" in row for row in rows
    )
    assert "gnc: holds to 30%, the most that was tried" in rows


def test_every_trial_as_json(recorded, capsys):
    code, out, _ = stressed(
        capsys, recorded, "--wrong-loops", "50", "--groups", "1,3", "--strategy", "none", "--json"
    )
    said = json.loads(out)
    assert code == 0
    assert [(t["share"], t["size"], t["wrong_offered"]) for t in said["trials"]] == [
        (0.5, 1, 10),
        (0.5, 3, 9),
    ]
    assert all(t["wrong"] == t["ever"] == t["wrong_offered"] for t in said["trials"]), "none refuses nothing"
    assert all(t["true"] == t["true_offered"] == len(PAIRS) for t in said["trials"])
    assert set(said["verdicts"]) == {"none, single ones", "none, groups of 3"}


def test_without_wrong_loops_the_map_is_the_recorded_one(recorded):
    stress = Stress(FinishedRun(recorded))
    assert stress.recorded == "none"
    trial = stress.trial("none", 0.0)
    assert trial.off < 1e-6
    assert not trial.broken


def test_the_same_seed_is_the_same_trial_whatever_was_tried_before(recorded):
    """All but its seconds."""
    first, other = Stress(FinishedRun(recorded), seed=4), Stress(FinishedRun(recorded), seed=4)
    other.trial("none", 0.5)

    def numbers(stress):
        return {name: value for name, value in stress.trial("none", 0.3).plain().items() if name != "seconds"}

    assert numbers(first) == numbers(other)
    assert numbers(Stress(FinishedRun(recorded), seed=5)) != numbers(first)


def test_what_is_tolerated_decides_what_is_broken(recorded):
    trial = Stress(FinishedRun(recorded), tolerance=1e6).trial("none", 0.5)
    assert trial.off > 1.0
    assert not trial.broken
    assert list(sentences([trial]).values()) == ["holds to 50%, the most that was tried"]
    worse = Stress(FinishedRun(recorded)).trial("none", 0.5)
    assert next(iter(sentences([worse]).values())).startswith("broken at 50%: ")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--wrong-loops", "0,130"], "'130' is no whole number from 0 to 99"),
        (["--wrong-loops", "some"], "'some' is no whole number"),
        (["--groups", "0"], "'0' is no whole number from 1 to 100"),
        (["--strategy", "gates"], "strategy 'gates'"),
    ],
)
def test_a_mistake_is_one_line(recorded, capsys, arguments, line):
    code, out, err = stressed(capsys, recorded, *arguments)
    assert (code, out) == (2, "")
    assert line in err
    assert len(err.splitlines()) == 1


def test_a_run_without_loops_or_without_its_inputs_is_one_line(tmp_path, capsys):
    written(tmp_path / "line.g2o", [])
    write_run(replay(tmp_path / "line.g2o").result, tmp_path / "run")
    code, _, err = stressed(capsys, tmp_path / "run")
    assert (code, "kept no loop" in err, len(err.splitlines())) == (2, True, 1)
    (tmp_path / "line.g2o").unlink()
    code, _, err = stressed(capsys, tmp_path / "run")
    assert (code, "line.g2o" in err, len(err.splitlines())) == (2, True, 1)


def test_loops_of_a_bag_get_company_too(tmp_path, capsys):
    """A simulated drive: odometry and loops are sources of their own."""
    from slam_backend.io.configfile import load_config
    from slam_backend.lab.options import Options
    from slam_backend.lab.simulate import simulate, write_simulation

    made = write_simulation(
        simulate("square", 3, Options(poses=600, loop_rate=0.05)), tmp_path / "square.mcap"
    )
    config = load_config(made.config).model_copy(update={"robust": ()})
    result = replay(made.bag, config).result
    write_run(result, tmp_path / "run")
    loops = result.summary["counts"]["loops_accepted"]
    code, out, _ = stressed(capsys, tmp_path / "run", "--wrong-loops", "10", "--strategy", "none", "--json")
    (trial,) = json.loads(out)["trials"]
    assert code == 0
    assert trial["true_offered"] == loops
    assert trial["wrong_offered"] == trial["wrong"] == round(loops / 9) > 0
    assert trial["true"] == loops
    assert trial["broken"]
