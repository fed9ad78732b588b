"""Ctrl-C while a verb works through a recording: what was read so far is a run like any other."""

import json
import signal

import pytest

from slam_backend import cli
from slam_backend.io.bags import open_bag, write_bag
from slam_backend.io.finished import FinishedRun
from slam_backend.io.history import History
from slam_backend.lab.simulate import Options, simulate, write_simulation


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    return write_simulation(simulate("square", 3, Options(poses=250, loop_rate=0.3)), folder / "drive.mcap")


@pytest.fixture
def replayed(drive, tmp_path, monkeypatch):
    """Replays with Ctrl-C at the 200th update, so many times; gives the exit code and where the run is."""
    see, out = History.see, tmp_path / "run"

    def replayed(interrupts):
        told = []

        def seen(history, update):
            told.append(update)
            see(history, update)
            for _ in range(interrupts if len(told) == 200 else 0):
                signal.raise_signal(signal.SIGINT)

        monkeypatch.setattr(History, "see", seen)
        line = ["replay", str(drive.bag), "--config", str(drive.config), "--out", str(out), "--no-report"]
        try:
            return cli.main(line), out
        finally:
            monkeypatch.setattr(History, "see", see)

    return replayed


def test_what_was_read_before_ctrl_c_is_saved_as_of_a_recording_that_ends_there(
    drive, replayed, tmp_path, capfd
):
    code, out = replayed(1)
    error, summary = capfd.readouterr().err, FinishedRun(out).summary
    assert (code, summary["ended"]) == (130, "interrupted")
    assert "what has been read so far is being saved" in error
    assert f"note: {summary['notes'][-1]}\n" in error
    assert 150 < summary["counts"]["keyframes"] < 230
    with open_bag(drive.bag) as opened:
        records = [each for each in opened.records() if each.topic != "/truth"]
    write_bag(tmp_path / "cut.mcap", records[: summary["counts"]["records"]])
    line = ["replay", str(tmp_path / "cut.mcap"), "--config", str(drive.config), "--no-report", "--json"]
    assert cli.main([*line, "--out", str(tmp_path / "cut")]) == 0
    cut = FinishedRun(tmp_path / "cut").summary
    assert cut["run_hash"] == summary["run_hash"]
    assert (cut["ended"], cut["notes"]) == ("input", [])


def test_an_interrupted_run_is_asked_and_edited_as_far_as_it_went(replayed, capfd):
    _, out = replayed(1)
    before = FinishedRun(out)
    assert before.again().result.summary["run_hash"] == before.summary["run_hash"]
    capfd.readouterr()
    assert cli.main(["edit", str(out), "--disable", "loops", "--json"]) == 0
    told, after = json.loads(capfd.readouterr().out), FinishedRun(out).summary
    assert told["run_hash"] == after["run_hash"] != before.summary["run_hash"]
    assert (after["ended"], after["counts"]["records"]) == (
        "interrupted",
        before.summary["counts"]["records"],
    )
    assert after["counts"]["loops_accepted"] == 0 < before.summary["counts"]["loops_accepted"]


def test_a_second_ctrl_c_leaves_at_once_and_saves_nothing(replayed, capfd):
    code, out = replayed(2)
    assert (code, out.exists()) == (130, False)
    assert capfd.readouterr().err.endswith("slam-backend: interrupted\n")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
