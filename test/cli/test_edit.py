"""A finished run is edited: what is asked is done or refused in a line, and what is left is a whole run again."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from slam_backend import cli
from slam_backend.io.bags import open_bag, write_bag
from slam_backend.io.configfile import load_config
from slam_backend.io.finished import FinishedRun
from slam_backend.io.records import Record
from slam_backend.io.replay import replay
from slam_backend.lab.simulate import Options, simulate, write_simulation

BATCH = ("--final", "batch")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A short drive with loops and landmarks, and its run directory."""
    folder = tmp_path_factory.mktemp("drive")
    options = Options(poses=250, loop_rate=0.3, landmarks=20)
    written = write_simulation(simulate("square", 3, options), folder / "drive.mcap")
    assert cli.main(["replay", str(written.bag), "--config", str(written.config), "--no-report", *BATCH,
                     "--out", str(folder / "run"), "--json"]) == 0  # fmt: skip
    return folder, written


@pytest.fixture
def run(drive, tmp_path):
    return Path(shutil.copytree(drive[0] / "run", tmp_path / "run"))


def edit(capsys, run, *arguments):
    """Exit code, JSON, the line of the error."""
    capsys.readouterr()
    code = cli.main(["edit", str(run), *arguments, "--json"])
    captured = capsys.readouterr()
    return code, json.loads(captured.out) if captured.out else {}, captured.err


def loops_of(run):
    return [
        line["id"]
        for line in FinishedRun(run).decisions
        if line["source"] == "loops" and line["verdict"] == "accepted"
    ]


def contents(run):
    """Of all files but the pictures, which no two writers make alike."""
    return {path.name: path.read_bytes() for path in run.iterdir() if path.suffix not in (".png", ".npz")}


def test_an_edit_is_in_every_file_of_the_run(run, capsys):
    loop = loops_of(run)[3]
    before = FinishedRun(run).summary
    code, told, _ = edit(capsys, run, "--disable", loop)
    assert code == 0
    after = FinishedRun(run)
    assert after.summary["run_hash"] == told["run_hash"] != before["run_hash"]
    assert after.summary["counts"]["factors"] == before["counts"]["factors"] - 1
    assert after.summary["counts"]["loops_accepted"] == before["counts"]["loops_accepted"] - 1
    assert after.summary["cost"]["final"] == pytest.approx(told["cost"]["after"], rel=1e-6)
    last = after.decision(loop)
    assert (last["verdict"], last["stage"], last["reason"]) == ("removed", "edit", "disabled")
    assert len((run / "edits.jsonl").read_text().splitlines()) == after.summary["edits"] == 1


def test_undo_gives_the_optimum_of_all_factors_back(run, capsys):
    before = np.loadtxt(run / "trajectory.tum")
    loop = loops_of(run)[3]
    edit(capsys, run, "--disable", loop, "--reweight", f"{loops_of(run)[5]}=0.01")
    edited = np.loadtxt(run / "trajectory.tum")
    assert np.abs(edited - before)[:, 1:].max() > 1e-5
    assert edit(capsys, run, "--undo")[0] == 0
    assert np.loadtxt(run / "trajectory.tum") == pytest.approx(before, abs=1e-6)
    assert FinishedRun(run).decision(loop)["verdict"] == "restored"
    assert edit(capsys, run, "--redo")[0] == 0
    assert np.loadtxt(run / "trajectory.tum") == pytest.approx(edited, abs=1e-6)
    assert [json.loads(line)["action"] for line in (run / "edits.jsonl").read_text().splitlines()] == [
        "edit",
        "undo",
        "redo",
    ]


def test_a_dry_run_tells_what_the_edit_does_and_touches_nothing(run, capsys):
    before, loop = contents(run), loops_of(run)[3]
    code, would, _ = edit(capsys, run, "--disable", loop, "--dry-run")
    assert code == 0
    assert contents(run) == before
    _, told, _ = edit(capsys, run, "--disable", loop)
    assert {name: told[name] for name in would} == would


def test_decided_anew_it_is_the_run_of_an_input_that_never_had_them(drive, run, capsys, tmp_path):
    """To the bit: the hash of a replay of a bag from which these loops were taken out."""
    folder, written = drive
    gone = loops_of(run)[2:5]
    code, told, _ = edit(capsys, run, *(word for loop in gone for word in ("--disable", loop)), "--replay")
    assert code == 0
    cut = write_without(written.bag, tmp_path / "cut.mcap", gone)
    reference = replay(cut, load_config(written.config), final="batch").result
    assert told["run_hash"] == reference.summary["run_hash"]
    assert told["run_hash"] == FinishedRun(run).again().result.summary["run_hash"]
    left = loops_of(run)
    assert not set(gone) & set(left)
    again = edit(capsys, run, "--disable", left[0], "--replay")[1]  # and once more, on what is left
    cut = write_without(written.bag, tmp_path / "more.mcap", [*gone, left[0]])
    assert (
        again["run_hash"]
        == replay(cut, load_config(written.config), final="batch").result.summary["run_hash"]
    )
    assert folder.exists()


def write_without(bag, path, ids):
    """A copy of a bag without the loops that have these ids, told by their order among all loops of the bag."""
    with open_bag(bag) as opened:
        records: list[Record] = list(opened.records())
    wanted = {id_.split("/")[1] for id_ in ids}
    with open_bag(bag) as opened:
        decode = opened.typestore.deserialize_cdr

        def is_gone(record: Record) -> bool:
            if record.topic != "/loops":
                return False
            message = decode(bytes(record.data), record.type)
            stamps = [message.header.frame_id.split("@")[1], message.child_frame_id.split("@")[1]]
            stamp = message.header.stamp
            return max(*stamps, f"{stamp.sec}.{stamp.nanosec:09d}") in wanted

        kept = [record for record in records if not is_gone(record)]
    assert len(records) - len(kept) == len(ids)
    write_bag(path, kept)
    return path


def test_a_span_of_time_is_edited_as_a_whole(run, capsys):
    stamps = sorted(id_.split("/")[1] for id_ in loops_of(run))
    code, told, _ = edit(
        capsys, run, "--source", "loops", "--from", stamps[2], "--to", stamps[4], "--dry-run"
    )
    assert code == 0
    assert [id_.split("/")[1] for id_ in told["factors"]] == stamps[2:5]
    everything = edit(capsys, run, "--disable", "loops", "--dry-run")[1]
    assert len(everything["factors"]) == len(stamps)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ([], "nothing to edit"),
        (["--disable", "loops/17.0/0"], "no factor 'loops/17.0/0'"),
        (["--disable", "lops"], "no factors of 'lops'"),
        (["--reweight", "loops"], "NAME=FACTOR"),
        (["--reweight", "loops=-1"], "positive number"),
        (["--undo"], "no edit to undo"),
        (["--undo", "--redo"], "stand alone"),
        (["--from", "noon"], "'noon' is not a stamp"),
        (["--disable", "loops", "--source", "landmarks"], "not of --source"),
        (["--undo", "--replay"], "leave out"),
    ],
)
def test_what_cannot_be_done_is_said_in_a_line_and_leaves_the_run(run, capsys, arguments, why):
    before = contents(run)
    code, _, error = edit(capsys, run, *arguments)
    assert code == 2
    assert why in error
    assert error.count("\n") == 1
    assert contents(run) == before


def test_an_input_that_is_gone_or_another_one_is_said(run, capsys, tmp_path):
    summary = json.loads((run / "summary.json").read_text())
    bag = Path(summary["input"][0])
    for path, why in ((tmp_path / "gone.mcap", "is not there"), (tmp_path / "cut.mcap", "takes another way")):
        if "cut" in path.name:
            with open_bag(bag) as opened:
                write_bag(path, list(opened.records())[::2])
        (run / "summary.json").write_text(json.dumps(summary | {"input": [str(path)]}))
        code, _, error = edit(capsys, run, "--disable", "loops")
        assert (code, error.count("\n")) == (2, 1)
        assert why in error


def test_a_run_that_was_saved_while_its_inputs_came_says_so(drive, run, capsys, tmp_path):
    with open_bag(drive[1].bag) as opened:
        records = list(opened.records())
    write_bag(tmp_path / "early.mcap", records[: 9 * len(records) // 10])
    assert cli.main(["replay", str(tmp_path / "early.mcap"), "--config", str(drive[1].config), "--no-report",
                     "--out", str(tmp_path / "early")]) == 0  # fmt: skip
    path = tmp_path / "early" / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"input": [str(drive[1].bag)]}))
    code, _, error = edit(capsys, tmp_path / "early", "--disable", "loops")
    assert (code, error.count("\n")) == (2, 1)
    assert "its inputs go on after its end" in error


def test_an_edit_of_a_pose_graph_takes_its_edges(capsys, tmp_path):
    """A square whose closing edge is wrong: without it, the shape of the others."""
    lines = [f"VERTEX_SE2 {n} 0 0 0\n" for n in range(4)]
    lines += [f"EDGE_SE2 {n} {n + 1} 1 0 1.5707963 100 0 0 100 0 100\n" for n in range(3)]
    (tmp_path / "square.g2o").write_text("".join([*lines, "EDGE_SE2 3 0 2 0 1.5707963 100 0 0 100 0 100\n"]))
    run = tmp_path / "run"
    believed = ["--set", "robust=[]"]  # or the closing edge would be refused
    assert (
        cli.main(
            ["replay", str(tmp_path / "square.g2o"), *believed, "--out", str(run), "--no-report", "--json"]
        )
        == 0
    )
    bent = np.loadtxt(run / "trajectory.tum")
    (loop,) = [line["id"] for line in FinishedRun(run).decisions if line["verdict"] == "accepted"]
    for anew in ([], ["--replay"]):
        assert edit(capsys, run, "--disable", loop, *anew)[0] == 0
        straight = np.loadtxt(run / "trajectory.tum")
        assert np.abs(straight - bent).max() > 0.1
        assert straight[3, 1:3] == pytest.approx([0, 1], abs=1e-6)
        assert edit(capsys, run, *(["--undo"] if not anew else ["--disable", "edges", "--dry-run"]))[0] == 0
