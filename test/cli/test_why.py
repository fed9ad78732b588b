"""Why a loop was accepted or refused, in words and as JSON; what it says of the difference is what an edit then does."""

import json

import pytest

from slam_backend import cli
from slam_backend.io.finished import FinishedRun
from slam_backend.lab.simulate import Options, simulate, write_simulation


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short drive of which a third of the loops are wrong."""
    folder = tmp_path_factory.mktemp("drive")
    options = Options(poses=400, loop_rate=0.4, wrong_loop_rate=0.3, landmarks=0)
    written = write_simulation(simulate("square", 3, options), folder / "drive.mcap")
    arguments = ["replay", str(written.bag), "--config", str(written.config), "--no-report", "--json"]
    assert cli.main([*arguments, "--out", str(folder / "run")]) == 0
    return folder / "run"


def why(capsys, *arguments):
    capsys.readouterr()
    code = cli.main(["why", *map(str, arguments)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def one(run, verdict):
    return next(d for d in FinishedRun(run).decisions if d["verdict"] == verdict and d["source"] == "loops")


def test_a_refused_loop_has_its_reason_its_distance_and_what_would_let_it_pass(run, capsys):
    refused = one(run, "refused")
    code, out, _ = why(capsys, run, refused["id"], "--json")
    told = json.loads(out)
    assert code == 0
    assert told["basis"] == refused["basis"]
    assert told["statistic"] > told["threshold"]
    assert told["basis"]["would_pass"]
    assert told["cost_with"] > told["cost_without"] + 1
    assert told["largest_shift"]["m"] > 0.01
    assert "would pass if" in why(capsys, run, refused["id"], "--quick")[1]


def test_an_accepted_loop_says_what_it_agrees_with_and_how_well_it_fits(run, capsys):
    accepted = one(run, "accepted")
    told = json.loads(why(capsys, run, accepted["id"], "--json")[1])
    assert told["weight"] == 1
    assert told["residual_chi2"] < 20
    assert told["life"][-1]["verdict"] == "accepted"
    assert told["cost_with"] >= told["cost_without"]


def test_a_loop_that_is_not_there_is_a_line_and_exit_code_2(run, capsys):
    code, _, line = why(capsys, run, "loops/1.000000000/0")
    assert code == 2
    assert "nothing was decided about 'loops/1.000000000/0'" in line
