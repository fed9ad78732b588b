"""`slam-backend doctor`: a table, what to mend, and an exit code."""

import json
from pathlib import Path

import pytest

from slam_backend.cli import main
from slam_backend.io.bags import write_bag
from slam_backend.io.encode import encode_string
from slam_backend.io.records import Record

BAG = Path(__file__).parents[2] / "bags/warehouse.mcap"


def test_a_sound_bag_is_a_table_and_exit_code_0(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", str(BAG)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("topic ")
    assert out.strip().endswith("nothing serious")


def test_what_nothing_can_drive_is_serious(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_bag(tmp_path / "talk.mcap", [Record("/chatter", "std_msgs/msg/String", 7, encode_string("hello"))])
    assert main(["doctor", str(tmp_path / "talk.mcap"), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["serious"]
    assert [topic["topic"] for topic in told["topics"]] == ["/chatter"]
    assert told["findings"][0]["advice"].startswith("record odometry")


def test_a_pose_graph_has_its_edges_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "two.g2o").write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 1 2 1 0 0 1 0 0 1 0 1\n")
    assert main(["doctor", str(tmp_path / "two.g2o")]) == 0
    assert "edges" in capsys.readouterr().out


def test_what_the_user_can_mend_is_exit_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", str(tmp_path / "missing.mcap")]) == 2
    config = tmp_path / "c.yaml"
    config.write_text("sources: [a]\na: {kind: odometry, topic: /nothing}\n")
    assert main(["doctor", str(BAG), "--config", str(config)]) == 2
    assert capsys.readouterr().out == ""
