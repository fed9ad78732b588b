"""`slam-backend journal`: what a journal holds, whether it is whole, a bag of it, and less space for it."""

import json
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest

from slam_backend.cli import main
from slam_backend.core.config import Config, Journaling, OdometrySource, config_to
from slam_backend.io import events
from slam_backend.io.bags import open_bag
from slam_backend.io.encode import encode_odometry
from slam_backend.io.journal import NAME, Journal
from slam_backend.io.restore import claim

GOLDEN = Path(__file__).parents[1] / "io" / "golden" / "unsealed.db3"
CONFIG = {"event": "config", "config": config_to(Config(sources={"wheels": OdometrySource(topic="/odom")}))}
ZEROS = np.zeros(36)


@pytest.fixture
def data_dir(tmp_path):
    """Of a node that ran once: a gap, thirty records."""
    journal = Journal(tmp_path, print, Journaling(commit_delay=0.001))
    journal.note({"event": "begin", "versions": {"slam_backend": "0.1.0"}})
    journal.note({**CONFIG, "hash": "abc"})
    for n in range(30):
        pose = (n, 0, 0, 0, 0, 0, 1)
        data = encode_odometry(n + 1, "odom", "base", pose, ZEROS, ZEROS[:6], ZEROS)
        journal.append("/odom", "nav_msgs/msg/Odometry", data)
    journal.note(events.gap(1, 2, 5, "the disk was full"))
    journal.close({"event": "end"})
    return tmp_path


def told(capsys, *words):
    code = main(["journal", *map(str, words)])
    output = capsys.readouterr()
    assert "Traceback" not in output.err
    return code, output.out, output.err


def test_info_tells_sessions_topics_and_time(data_dir, capsys) -> None:
    """A folder or the file; for people and for machines."""
    code, out, _ = told(capsys, "info", data_dir)
    assert code == 0
    for part in (
        "34 records",
        "30  /odom",
        "begin  slam_backend 0.1.0",
        "wheels",
        "5 records lost: the disk was full",
    ):
        assert part in out
    code, out, _ = told(capsys, "info", data_dir / NAME, "--json")
    data = json.loads(out)
    assert data["topics"] == {"/odom": 30, events.TOPIC: 4}
    assert [event["event"] for event in data["events"]] == ["begin", "config", "gap", "end"]
    assert data["damage"] == []


def test_verify_is_for_scripts(data_dir, capsys) -> None:
    """Exit code 1 where a record does not match its checksum; a gap that is confessed is no damage."""
    code, out, _ = told(capsys, "verify", data_dir)
    assert (code, "gap:" in out, "is whole" in out) == (0, True, True)
    with sqlite3.connect(data_dir / NAME) as database:
        database.execute("UPDATE messages SET timestamp = timestamp + 1 WHERE id = 17")
    code, out, _ = told(capsys, "verify", data_dir)
    assert code == 1
    assert "1 records are missing or damaged, and left out: rows 17" in out
    code, out, _ = told(capsys, "verify", data_dir, "--json")
    assert (code, json.loads(out)["whole"]) == (1, False)


def test_an_older_journal_can_be_looked_at_as_well(capsys) -> None:
    code, out, _ = told(capsys, "verify", GOLDEN)
    assert (code, "40 records" in out) == (0, True)


def test_export_is_an_ordinary_bag(data_dir, tmp_path, capsys) -> None:
    """The whole records of a damaged one, and words about the others."""
    with open_bag(data_dir / NAME) as bag:
        before = [(record.topic, record.log_time, bytes(record.data)) for record in bag.records()]
    assert told(capsys, "export", data_dir, tmp_path / "whole.mcap")[0] == 0
    with open_bag(tmp_path / "whole.mcap") as bag:
        assert [(record.topic, record.log_time, bytes(record.data)) for record in bag.records()] == before
    with sqlite3.connect(data_dir / NAME) as database:
        database.execute("UPDATE messages SET data = x'00' WHERE id = 17")
    code, out, err = told(capsys, "export", data_dir, tmp_path / "rest")
    assert (code, "33 records" in out, "rows 17" in err) == (0, True, True)


def test_compact_loses_nothing_that_was_heard(data_dir, capsys) -> None:
    """Of every session in the folder; one in which nothing was heard goes."""
    shutil.copy(data_dir / NAME, data_dir / "journal-1.db3")
    (data_dir / "silent").mkdir()
    silent = Journal(data_dir / "silent", print)
    silent.note({"event": "begin"})
    silent.close({"event": "end"})
    silent.path.rename(data_dir / "journal-2.db3")
    database = sqlite3.connect(data_dir / NAME)
    database.executescript("CREATE TABLE big(x); INSERT INTO big VALUES (zeroblob(1000000)); DROP TABLE big")
    database.close()  # room that nobody needs any more
    before, size = told(capsys, "info", data_dir, "--json")[1], (data_dir / NAME).stat().st_size
    code, out, _ = told(capsys, "compact", data_dir)
    assert code == 0
    assert "nothing was heard in that session: removed" in out
    assert sorted(path.name for path in data_dir.glob("*.db3")) == ["journal-1.db3", NAME]
    assert told(capsys, "info", data_dir, "--json")[1] == before
    assert (data_dir / NAME).stat().st_size < size - 900_000
    Journal(data_dir, print).close()  # and it can be gone on with
    assert told(capsys, "verify", data_dir)[0] == 0


def test_what_is_damaged_or_in_use_is_left_as_it_is(data_dir, capsys) -> None:
    held = claim(data_dir)
    code, _, err = told(capsys, "compact", data_dir)
    assert (code, "another process writes its journal there" in err) == (2, True)
    held.close()
    with sqlite3.connect(data_dir / NAME) as database:
        database.execute("DELETE FROM messages WHERE id = 9")
    before = (data_dir / NAME).read_bytes()
    code, _, err = told(capsys, "compact", data_dir)
    assert (code, "left as it is" in err) == (2, True)
    assert (data_dir / NAME).read_bytes() == before


@pytest.mark.parametrize(
    "words",
    [
        ("info", "nowhere"),
        ("compact", "nowhere"),
        ("export", "nowhere"),
        ("info", "nowhere", "out"),
        ("burn", "nowhere"),
    ],
)
def test_mistakes_are_one_line(tmp_path, capsys, words) -> None:
    code, _, err = told(capsys, words[0], *(tmp_path / word for word in words[1:]))
    assert code == 2
    assert err.count("\n") == 1
