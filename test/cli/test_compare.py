"""`compare` and `replay --sweep`: equal runs are identical, worse ones are found, and scripts see it in the exit code."""

import json

import pytest

from slam_backend.cli import main
from slam_backend.io.configfile import load_config
from slam_backend.io.replay import replay
from slam_backend.io.rundir import write_run
from slam_backend.lab.simulate import Options, simulate, write_simulation


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive with wrong loops."""
    options = Options(poses=300, loop_rate=0.3, wrong_loop_rate=0.3)
    return write_simulation(simulate("square", 2, options), tmp_path_factory.mktemp("drive") / "drive.mcap")


@pytest.fixture(scope="module")
def runs(drive, tmp_path_factory):
    """good and its twin; bad, on purpose: the wrong loops are believed."""
    folder = tmp_path_factory.mktemp("runs")
    for name, kernel in (("good", "cauchy"), ("twin", "cauchy"), ("bad", "none")):
        run = replay(drive.bag, load_config(drive.config), ["robust=[]", f"loops.kernel={kernel}"])
        write_run(run.result, folder / name)
    return folder


def compare(runs, *names):
    return ["compare", *(str(runs / name) if name in ("good", "twin", "bad") else name for name in names)]


def test_equal_runs_are_identical_and_fail_no_check(runs, capsys):
    assert (
        main(
            compare(
                runs, "good", "twin", "--fail-if", "apart > 0", "--fail-if", "flips > 0 or cost > base.cost"
            )
        )
        == 0
    )
    assert "twin: identical" in capsys.readouterr().out


def test_a_run_made_worse_on_purpose_fails(runs, capsys):
    assert main(compare(runs, "good", "twin", "bad", "--fail-if", "apart > 0.5")) == 1
    told = capsys.readouterr()
    assert told.err == "failed: bad: apart > 0.5\n"
    assert "bad: loops.kernel: none instead of cauchy" in told.out
    assert "bad: parts at 17000000" in told.out


def test_against_a_truth_errors_can_be_checked(runs, drive, capsys):
    pytest.importorskip("evo", reason="evo is not installed (extra `eval`)")
    check = ["--truth", str(drive.truth), "--fail-if", "ate > 1.05 * base"]
    assert main(compare(runs, "good", "bad", *check)) == 1
    assert main(compare(runs, "bad", "good", *check)) == 0
    assert "ATE (m)" in capsys.readouterr().out


def test_everything_is_there_as_json_and_as_a_page(runs, tmp_path, capsys):
    assert main(compare(runs, "good", "bad", "--json", "--html", str(tmp_path / "page.html"))) == 0
    base, bad = json.loads(capsys.readouterr().out)
    assert base["identical"]
    assert not bad["identical"]
    assert base["parting"] is None
    assert bad["settings"] == {"loops.kernel": ["cauchy", "none"]}
    assert bad["numbers"]["apart"] > 0.5
    assert len(bad["parting"]["place"]) == 3
    page = (tmp_path / "page.html").read_text()
    for words in ("Numbers", "Trajectories", "Where they part", "bad parts at"):
        assert words in page


def test_a_filter_s_refusals_are_decisions_that_flipped(runs, drive, tmp_path, capsys):
    from slam_backend.lab.ekf import Ekf

    run = replay(drive.bag, load_config(drive.config), ["robust=[]", "loops.kernel=cauchy"], estimator=Ekf)
    write_run(run.result, tmp_path / "filter")
    assert main([*compare(runs, "good"), str(tmp_path / "filter"), "--json"]) == 0
    _, filter_ = json.loads(capsys.readouterr().out)
    refused = run.result.summary["counts"]["loops_refused"]
    assert refused > 10
    assert filter_["numbers"]["flips"] == refused
    assert {(flip["base"], flip["verdict"]) for flip in filter_["flips"]} == {("accepted", "refused")}
    assert filter_["settings"]["estimator"] == ["isam2", "ekf"]


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["good"], "needs two runs"),
        (["good", "nowhere"], "no such directory"),
        (["good", "bad", "--fail-if", "atee > base"], "did you mean 'ate'"),
        (["good", "bad", "--fail-if", "ate > base"], "not known for these runs"),
    ],
)
def test_mistakes_get_one_line(runs, arguments, why, capsys):
    assert main(compare(runs, *arguments)) == 2
    err = capsys.readouterr().err
    assert why in err
    assert err.count("\n") == 1


def test_runs_of_different_drives_are_not_compared(runs, tmp_path, capsys):
    other = write_simulation(simulate("square", 1, Options(poses=30)), tmp_path / "other.mcap")
    config = load_config(other.config)
    shifted = replay(other.bag, config).result
    write_run(shifted, tmp_path / "other")
    path = tmp_path / "other"
    for name in ("trajectory.tum", "odometry.tum", "online.tum"):
        text = (path / name).read_text().replace("17000000", "18000000")
        (path / name).write_text(text)
    assert main([*compare(runs, "good"), str(path)]) == 2
    assert "not runs of the same drive" in capsys.readouterr().err


def test_a_sweep_makes_a_run_for_each_combination_and_compares_them(drive, tmp_path, capsys):
    out = tmp_path / "sweep"
    command = ["replay", str(drive.bag), "--config", str(drive.config), "--no-report", "--out", str(out)]
    assert main([*command, "--sweep", "loops.kernel=cauchy,none,fiction"]) == 2
    told = capsys.readouterr()
    assert sorted(path.name for path in out.iterdir()) == ["loops.kernel=cauchy", "loops.kernel=none"]
    assert "failed: loops.kernel=fiction: " in told.err
    assert "#1: loops.kernel: none instead of cauchy" in told.out
    assert main([*command, "--sweep", "loops.kernel"]) == 2
