"""What is gone on with after a crash, and what is not; a damaged journal gives all that is whole, and says what is not."""

import json
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest

from bench import crash
from bench.damage import content_of, flip, write
from bench.laps import config as laps_config
from bench.laps import laps
from slam_backend.core.config import Config, OdometrySource, config_to
from slam_backend.core.errors import BadFile
from slam_backend.io import events
from slam_backend.io.bags import open_bag
from slam_backend.io.finished import FinishedRun
from slam_backend.io.journal import NAME, Journal
from slam_backend.io.replay import replay
from slam_backend.io.restore import RUN, claim, examine, salvage, set_aside, unfinished
from slam_backend.io.rundir import write_run

GOLDEN = Path(__file__).parent / "golden" / "unsealed.db3"
CONFIG = Config(space="2d", sources={"wheels": OdometrySource(topic="/odom")})


def lived(folder, *said, rows=3, end=None):
    """A journal of one process: its words, some rows, its last word."""
    journal = Journal(folder, print)
    for event in said:
        journal.note(event)
    for n in range(rows):
        journal.append("/odom", "nav_msgs/msg/Odometry", b"%d" % n)
    journal.close(end)
    return journal.path


BEGIN, CONFIGURED, END = (
    {"event": "begin"},
    {"event": "config", "config": config_to(CONFIG)},
    {"event": "end"},
)


@pytest.mark.parametrize(
    ("end", "resume", "goes_on"),
    [
        (None, "unfinished", True),
        (END, "unfinished", False),
        (END, "always", True),
        (None, "never", False),
    ],
)
def test_a_session_that_was_not_ended_goes_on(tmp_path, end, resume, goes_on) -> None:
    lived(tmp_path, BEGIN, CONFIGURED, end=end)
    found = unfinished(tmp_path, resume)
    assert (found is not None) == goes_on
    if found is not None:
        assert found.topics == {"/odom": 3, events.TOPIC: 2 + (end is not None)}
        assert found.config == CONFIG
        assert (found.damage, found.torn) == ([], "")


def test_where_there_is_nothing_nothing_goes_on(tmp_path) -> None:
    assert unfinished(tmp_path, "unfinished") is None
    lived(tmp_path, rows=0)
    assert unfinished(tmp_path, "always") is None


def test_a_journal_of_an_older_version_goes_on_unless_its_run_was_saved(tmp_path) -> None:
    """It does not say itself whether it was ended."""
    shutil.copy(GOLDEN, tmp_path / NAME)
    found = unfinished(tmp_path, "unfinished")
    assert found is not None
    assert (found.records, found.config, found.damage) == (40, None, [])
    (tmp_path / RUN).mkdir()
    assert unfinished(tmp_path, "unfinished") is None


def test_only_settings_that_decide_the_result_are_compared(tmp_path) -> None:
    found = examine(lived(tmp_path, CONFIGURED))
    assert found.is_solved_alike(CONFIG.model_copy(update={"data_dir": "elsewhere", "autostart": False}))
    assert not found.is_solved_alike(CONFIG.model_copy(update={"space": "3d"}))


def test_what_is_whole_of_a_damaged_journal_goes_on(tmp_path) -> None:
    """In a new file that confesses the gap; the damaged one is kept."""
    rng, whole = np.random.default_rng(4), write(tmp_path, 200, closed=True)
    content = content_of(tmp_path)
    while not (found := examine(flip(content, rng, tmp_path / "data"))).damage:
        pass
    before = found.path.read_bytes()
    said = salvage(found)
    assert "\n" not in said
    assert f"{found.records} whole records go on, the damaged file is journal-1.db3" in said
    assert (tmp_path / "data" / "journal-1.db3").read_bytes() == before
    after = examine(found.path)
    assert after.damage == []
    assert [event["event"] for _, event in after.events] == ["gap"]
    with open_bag(found.path) as bag:
        kept = [(r.topic, r.log_time, r.data) for r in bag.records() if r.topic != events.TOPIC]
    assert len(kept) == found.records < len(whole)
    assert all(record in whole for record in kept)
    journal = Journal(tmp_path / "data", print)
    journal.append("/odom", "nav_msgs/msg/Odometry", b"")
    journal.close()
    assert examine(found.path).records == after.records + 1


def test_a_journal_of_which_nothing_is_left_is_said(tmp_path) -> None:
    (tmp_path / NAME).write_bytes(np.random.default_rng(0).bytes(50_000))
    with pytest.raises(BadFile, match=r"journal\.db3: [^\n]+$"):
        unfinished(tmp_path, "unfinished")
    lived(tmp_path / "emptied")
    with sqlite3.connect(tmp_path / "emptied" / NAME) as database:
        database.execute("DELETE FROM messages")
    with pytest.raises(BadFile, match="3 records are missing or damaged"):
        unfinished(tmp_path / "emptied", "unfinished")


def test_a_folder_has_one_writer(tmp_path) -> None:
    first = claim(tmp_path)
    with pytest.raises(BadFile, match="another process writes its journal there"):
        claim(tmp_path)
    first.close()
    claim(tmp_path).close()


def test_what_is_set_aside_takes_the_next_free_number(tmp_path) -> None:
    """Journal and run together."""
    for n in (1, 2):
        lived(tmp_path)
        (tmp_path / RUN).mkdir()
        assert set_aside(tmp_path) == n
        assert (tmp_path / f"journal-{n}.db3").exists()
        assert (tmp_path / f"run-{n}").is_dir()
    assert not (tmp_path / NAME).exists()
    assert not (tmp_path / RUN).exists()


def test_a_session_that_is_set_aside_can_still_be_asked_and_edited(tmp_path) -> None:
    """Its run, and one that was saved on the way, know where its journal is now; those of others stay as they are."""
    journal = Journal(tmp_path, print)
    for record in laps(140, 5):
        journal.append(record.topic, record.type, record.data)
    journal.close(END)
    result = replay(journal.path, laps_config()).result
    for name in ("run", "runs/saved", "runs/other"):
        write_run(result, tmp_path / name)
    other = tmp_path / "runs" / "other" / "summary.json"
    other.write_text(json.dumps(result.summary | {"input": ["/elsewhere/journal.db3"]}))
    before = other.read_bytes()
    assert set_aside(tmp_path) == 1
    lived(tmp_path)  # the next session
    for name in ("run-1", "runs/saved"):
        finished = FinishedRun(tmp_path / name)
        assert finished.summary == result.summary | {"input": [str(tmp_path / "journal-1.db3")]}
        again = finished.again()
        assert again.result.summary["run_hash"] == result.summary["run_hash"]
        finished.compare(again)
    assert other.read_bytes() == before


@pytest.mark.slow
def test_whatever_is_killed_and_when_nothing_acknowledged_is_lost(tmp_path) -> None:
    """Process, worker or both, ten times in each of two drives; these end with the hash of their replay."""
    assert [(row.what, row.value) for row in crash.rows(kills=20) if not row.holds] == []
