"""The journal: everything that was heard, in order, readable by anybody, whatever happens to the disk."""

import shutil
import sqlite3
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from slam_backend.core.config import Journaling
from slam_backend.core.errors import BadFile
from slam_backend.io import events
from slam_backend.io import journal as module
from slam_backend.io.bags import open_bag
from slam_backend.io.cdr import Decoder
from slam_backend.io.encode import encode_odometry
from slam_backend.io.inputs import OWN
from slam_backend.io.journal import Journal, JournalReader
from slam_backend.io.schema import MANY
from slam_backend.io.typestore import typestore_of

ODOMETRY = "nav_msgs/msg/Odometry"
GOLDEN = Path(__file__).parent / "golden" / "unsealed.db3"


def message(n):
    zeros = np.zeros(36)
    return encode_odometry(n + 1, "odom", "base", (n, 0, 0, 0, 0, 0, 1), zeros, np.zeros(6), zeros)


def until(condition, seconds=5.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)


def rows(path):
    reader = JournalReader(path)
    found = reader.after(0, 1_000_000)
    reader.close()
    return found


@pytest.fixture
def complaints():
    return []


@pytest.fixture
def journal(tmp_path, complaints):
    journal = Journal(tmp_path, complaints.append)
    yield journal
    journal.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "journal"]


def test_rows_can_be_read_while_others_are_written(journal) -> None:
    """In batches of any size, each row once, in order of arrival."""
    reader, seen = JournalReader(journal.path), []
    for n in range(300):
        journal.append("/odom", ODOMETRY, message(n))
        if n % 50 == 0:
            assert journal.wait(len(seen), 5)
            seen += reader.after(len(seen), 7)
    until(lambda: journal.committed == 300)
    while len(seen) < 300:
        seen += reader.after(len(seen), 100)
    reader.close()
    assert [row.id for row in seen] == list(range(1, 301))
    assert [row.record.data for row in seen] == [message(n) for n in range(300)]


def test_log_times_increase_strictly_though_the_clock_stands_or_goes_back(journal, monkeypatch) -> None:
    """Readers order by them."""
    times = iter([5, 5, 5, 3, 10, 9])
    monkeypatch.setattr(module, "time_ns", lambda: next(times))
    for n in range(6):
        journal.append("/odom", ODOMETRY, message(n))
    until(lambda: journal.committed == 6)
    assert [row.record.log_time for row in rows(journal.path)] == [5, 6, 7, 8, 10, 11]


def test_many_threads_append_and_nothing_is_lost(journal) -> None:
    def append(topic):
        for n in range(500):
            journal.append(topic, ODOMETRY, message(n))

    threads = [threading.Thread(target=append, args=(f"/odom{k}",)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    until(lambda: journal.committed == 2000)
    found = rows(journal.path)
    assert all(a.record.log_time < b.record.log_time for a, b in pairwise(found))
    for k in range(4):
        assert [r.record.data for r in found if r.record.topic == f"/odom{k}"] == [
            message(n) for n in range(500)
        ]


@pytest.mark.parametrize("count", [1, MANY - 1, MANY, 2 * MANY + 7])
def test_however_many_come_in_one_commit_each_is_there_and_whole(tmp_path, complaints, count) -> None:
    journal = Journal(tmp_path, complaints.append, Journaling(commit_delay=5.0))
    for n in range(count):
        journal.append("/loops" if n % 3 else "/odom", ODOMETRY, message(n))
    assert (journal.waiting, journal.committed) == (count, 0)
    journal.close()
    found = rows(journal.path)
    assert [row.id for row in found] == list(range(1, count + 1))
    assert [(row.record.topic, row.record.data) for row in found] == [
        ("/loops" if n % 3 else "/odom", message(n)) for n in range(count)
    ]


def test_it_is_an_ordinary_bag_of_one_file(journal) -> None:
    """Closed, nothing but the one file is needed to read it, definitions included."""
    for n in range(10):
        journal.append("/odom", ODOMETRY, message(n))
    journal.close()
    assert not journal.path.with_name("journal.db3-wal").exists()
    with open_bag(journal.path) as bag:
        assert [(r.topic, r.type, bytes(r.data)) for r in bag.records()] == [
            ("/odom", ODOMETRY, message(n)) for n in range(10)
        ]
    (text,) = sqlite3.connect(journal.path).execute(
        "SELECT encoded_message_definition FROM message_definitions"
    )
    assert "geometry_msgs/PoseWithCovariance pose" in text[0]


def test_a_topic_on_which_nothing_came_is_there(journal) -> None:
    """With the type that was announced, or with that of the first message."""
    journal.announce({"/loops": ODOMETRY, "/tags": ODOMETRY, "/odom": ODOMETRY})
    until(lambda: len(sqlite3.connect(journal.path).execute("SELECT * FROM topics").fetchall()) == 3)
    journal.append("/odom", ODOMETRY, message(0))
    journal.append("/tags", "sensor_msgs/msg/PointCloud2", b"")
    journal.append("/odom", ODOMETRY, message(1))
    journal.close()
    with open_bag(journal.path) as bag:
        assert {name: (topic.type, topic.count) for name, topic in bag.topics.items()} == {
            "/loops": (ODOMETRY, 0),
            "/odom": (ODOMETRY, 2),
            "/tags": ("sensor_msgs/msg/PointCloud2", 1),
        }


def test_opened_again_it_goes_on(journal, tmp_path, complaints) -> None:
    """Ids and log times continue, topics keep their rows."""
    journal.append("/odom", ODOMETRY, message(0))
    journal.close()
    again = Journal(tmp_path, complaints.append)
    assert again.committed == 1
    again.append("/odom", ODOMETRY, message(1))
    again.append("/odometry", ODOMETRY, message(2))
    again.close()
    found = rows(journal.path)
    assert [(row.id, row.record.topic) for row in found] == [(1, "/odom"), (2, "/odom"), (3, "/odometry")]
    assert all(a.record.log_time < b.record.log_time for a, b in pairwise(found))


def test_what_was_committed_survives_sigkill(tmp_path) -> None:
    code = (
        "import os, sys\nfrom pathlib import Path\nfrom slam_backend.io.journal import Journal\n"
        "journal = Journal(Path(sys.argv[1]), print)\n"
        "for n in range(1000): journal.append('/odom', 'nav_msgs/msg/Odometry', b'%d' % n)\n"
        "journal.wait(999, 10)\nos.kill(os.getpid(), 9)"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(tmp_path)], timeout=60, check=False)
    assert ended.returncode == -9
    assert [row.record.data for row in rows(tmp_path / "journal.db3")] == [b"%d" % n for n in range(1000)]


def test_a_full_disk_is_said_once_and_waited_out(journal, complaints, monkeypatch) -> None:
    """Records wait in memory, those of a topic that was new among them; when there is room again, nothing is lost."""
    monkeypatch.setattr(module, "RETRY", 0.05)
    journal.append("/odom", ODOMETRY, message(0))
    until(lambda: journal.committed == 1)
    journal._database.execute("PRAGMA max_page_count=1")
    for n in range(1, 200):
        journal.append("/new" if n % 2 else "/odom", ODOMETRY, message(n))
    until(lambda: complaints)
    time.sleep(0.3)
    (line,) = complaints
    assert str(journal.path) in line
    assert "disk is full" in line
    assert "\n" not in line
    assert journal.waiting == 199
    journal._database.execute("PRAGMA max_page_count=1000000")
    until(lambda: journal.committed == 200)
    assert [row.record.data for row in rows(journal.path)] == [message(n) for n in range(200)]
    journal._database.execute("PRAGMA max_page_count=1")
    for n in range(200):
        journal.append("/odom", ODOMETRY, message(n))
    until(lambda: len(complaints) == 2)


def test_memory_is_bounded_and_what_is_lost_is_counted(journal, complaints, monkeypatch) -> None:
    monkeypatch.setattr(module, "RETRY", 0.05)
    monkeypatch.setattr(module, "LIMIT", 50)
    journal._database.execute("PRAGMA max_page_count=1")
    for n in range(60):
        journal.append("/odom", ODOMETRY, message(n) * 10)
    until(lambda: complaints)
    assert (journal.waiting, journal.lost) == (50, 10)
    journal.close()
    assert "its last 50 records could not be written" in complaints[-1]


def test_bytes_in_memory_are_bounded_too(journal, complaints, monkeypatch) -> None:
    monkeypatch.setattr(module, "RETRY", 0.05)
    monkeypatch.setattr(module, "LIMIT_BYTES", 5000)
    journal._database.execute("PRAGMA max_page_count=1")
    for _ in range(60):
        journal.append("/odom", ODOMETRY, bytes(100))
    until(lambda: len(complaints) == 2)
    assert (journal.waiting, journal.lost) == (50, 10)
    assert any("memory is full: /odom is lost" in line for line in complaints)
    journal._database.execute("PRAGMA max_page_count=1000000")
    until(lambda: journal.waiting == 0)
    for _ in range(50):
        journal.append("/odom", ODOMETRY, bytes(100))
    assert journal.lost == 10


def test_a_flood_does_not_crowd_out_the_driving_source(journal, complaints, monkeypatch) -> None:
    monkeypatch.setattr(module, "RETRY", 0.05)
    monkeypatch.setattr(module, "LIMIT", 100)
    journal.protected = ("/odom",)
    journal._database.execute("PRAGMA max_page_count=1")
    for _ in range(200):
        journal.append("/scan", "sensor_msgs/msg/PointCloud2", bytes(100))
    for n in range(24):
        journal.append("/odom", ODOMETRY, message(n))
    assert (journal.waiting, journal.lost) == (100, 125)  # the gap is one of them
    until(lambda: len(complaints) == 2)
    journal._database.execute("PRAGMA max_page_count=1000000")
    until(lambda: journal.waiting == 0)
    found = [row.record for row in rows(journal.path)]
    assert [record.data for record in found if record.topic == "/odom"] == [message(n) for n in range(24)]
    assert [events.event_of(r.data)["lost"] for r in found if r.topic == events.TOPIC] == [125]


def test_what_was_lost_before_it_came_here_is_confessed_as_well(journal, complaints) -> None:
    journal.append("/odom", ODOMETRY, message(0))
    journal.miss({"/scan": 7, "/tags": 2}, "no room")
    journal.append("/odom", ODOMETRY, message(1))
    journal.close()
    found = [row.record for row in rows(journal.path)]
    assert [record.topic for record in found] == ["/odom", events.TOPIC, "/odom"]
    gap = events.event_of(found[1].data)
    assert (gap["lost"], gap["why"]) == (9, "no room: 7 of /scan, 2 of /tags")
    assert journal.lost == 9
    assert "no room: 7 of /scan, 2 of /tags" in complaints[0]


def test_a_gap_is_confessed_in_the_journal(journal, complaints, monkeypatch) -> None:
    """Where it lies, before all that came afterwards, and told to whoever decodes the journal."""
    monkeypatch.setattr(module, "RETRY", 0.05)
    monkeypatch.setattr(module, "LIMIT", 50)
    journal._database.execute("PRAGMA max_page_count=1")
    for n in range(67):
        journal.append("/odom", ODOMETRY, message(n) * 10)
    until(lambda: complaints)
    journal._database.execute("PRAGMA max_page_count=1000000")
    until(lambda: journal.committed >= 51)
    journal.append("/odom", ODOMETRY, message(99))
    journal.close()
    found = [row.record for row in rows(journal.path)]
    assert [record.topic for record in found] == ["/odom"] * 50 + [events.TOPIC, "/odom"]
    gap = events.event_of(found[50].data)
    assert gap["lost"] == 17
    assert found[49].log_time == gap["after"] < gap["until"] <= found[50].log_time
    (decision,) = Decoder(typestore_of(()), OWN).decode(found[50])
    assert (decision.stage, decision.reason, decision.verdict, decision.count) == (
        "journal",
        "gap",
        "refused",
        17,
    )


def test_what_waits_for_the_disk_may_be_applied_from_memory(journal, complaints, monkeypatch) -> None:
    """Only then: otherwise nothing is handed out that is not on disk."""
    monkeypatch.setattr(module, "RETRY", 0.05)
    journal.append("/odom", ODOMETRY, message(0))
    assert journal.wait(0, 5)
    assert (journal.ready, journal.committed) == (1, 1)
    journal._database.execute("PRAGMA query_only=ON")  # as on a disk that has become read-only
    for n in range(1, 20):
        journal.append("/odom", ODOMETRY, message(n))
    until(lambda: complaints)
    assert "readonly" in complaints[0]
    assert (journal.ready, journal.committed) == (20, 1)
    assert journal.unwritten(0, 100) == []  # that row is in the file
    assert [row.id for row in journal.unwritten(1, 5)] == [2, 3, 4, 5, 6]
    assert [row.record.data for row in journal.unwritten(15, 100)] == [message(n) for n in range(15, 20)]
    journal._database.execute("PRAGMA query_only=OFF")
    until(lambda: journal.committed == 20)
    assert journal.ready == 20
    assert [row.record.data for row in rows(journal.path)] == [message(n) for n in range(20)]


def test_a_folder_that_vanishes_is_made_anew_with_all_that_was_in_it(journal, complaints) -> None:
    """SQLite itself would go on writing into a file that nobody sees."""
    for n in range(300):
        journal.append("/odom", ODOMETRY, message(n))
    until(lambda: journal.committed == 300)
    shutil.rmtree(journal.path.parent)
    journal.append("/loops", ODOMETRY, message(300))
    until(lambda: journal.committed == 301)
    assert "had vanished" in complaints[0]
    journal.append("/odom", ODOMETRY, message(301))
    until(lambda: journal.committed == 302)
    assert [row.record.data for row in rows(journal.path)] == [message(n) for n in range(302)]
    assert len(complaints) == 1


def test_a_file_of_somebody_else_in_its_place_is_not_touched(journal, complaints, monkeypatch) -> None:
    """Moved away, the journal is there again."""
    monkeypatch.setattr(module, "RETRY", 0.05)
    journal.append("/odom", ODOMETRY, message(0))
    until(lambda: journal.committed == 1)
    journal.path.unlink()
    other = sqlite3.connect(journal.path)
    other.executescript("CREATE TABLE messages(id INTEGER PRIMARY KEY)")
    other.close()
    before = journal.path.read_bytes()
    journal.append("/odom", ODOMETRY, message(1))
    until(lambda: complaints)
    assert "another file has taken its place" in complaints[0]
    assert journal.path.read_bytes() == before
    journal.path.unlink()
    until(lambda: journal.committed == 2)
    assert [row.record.data for row in rows(journal.path)] == [message(0), message(1)]


@pytest.mark.parametrize("commit", ["group", "full"])
def test_a_commit_waits_for_the_disk(tmp_path, complaints, commit) -> None:
    """synchronous=NORMAL would leave the newest commits in the cache of the kernel; full: each record has a commit of its own."""
    journal = Journal(tmp_path, complaints.append, Journaling(commit=commit, commit_delay=0.02))
    assert journal._database.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    assert journal._database.execute("PRAGMA synchronous").fetchone() == (2,)  # FULL
    commits = []
    journal._database.set_trace_callback(lambda said: commits.append(said) if said == "COMMIT" else None)
    for n in range(100):
        journal.append("/odom", ODOMETRY, message(n))
    until(lambda: journal.committed == 100)
    journal.close()
    assert (len(commits) == 100) == (commit == "full")
    assert [row.record.data for row in rows(journal.path)] == [message(n) for n in range(100)]


def test_a_row_that_rots_is_not_handed_out(journal) -> None:
    """The others are."""
    for n in range(20):
        journal.append("/odom", ODOMETRY, message(n))
    until(lambda: journal.committed == 20)
    with sqlite3.connect(journal.path) as database:
        database.execute("UPDATE messages SET data = ? WHERE id = 7", (message(99),))
    found = rows(journal.path)
    assert [row.id for row in found if row.record is None] == [7]
    assert len(found) == 20


def test_a_journal_from_before_there_were_checksums_goes_on_with_them(tmp_path, complaints) -> None:
    """A file of the first release, as it lies on robots."""
    shutil.copy(GOLDEN, tmp_path / "journal.db3")
    with open_bag(GOLDEN) as bag:
        before = [(record.topic, record.log_time, record.data) for record in bag.records()]
        assert bag.damage == []
    journal = Journal(tmp_path, complaints.append)
    assert journal.committed == len(before) == 40
    journal.append("/odom", ODOMETRY, message(0))
    journal.close()
    with open_bag(journal.path) as bag:
        after = [(record.topic, record.log_time, record.data) for record in bag.records()]
        assert bag.damage == []
    assert after[:-1] == before
    assert all(row.record is not None for row in rows(journal.path))


def test_a_journal_of_a_later_version_is_left_alone(tmp_path, complaints) -> None:
    shutil.copy(GOLDEN, tmp_path / "journal.db3")
    with sqlite3.connect(tmp_path / "journal.db3") as database:
        database.execute("PRAGMA user_version=99")
    with pytest.raises(BadFile, match="a newer version of slam_backend has written it"):
        Journal(tmp_path, complaints.append)


@pytest.mark.parametrize("what", ["a file", "in a file", "no database"])
def test_a_folder_that_cannot_be_used_is_one_line(tmp_path, what) -> None:
    (tmp_path / "file").write_text("something else")
    folder = {
        "a file": tmp_path / "file",
        "in a file": tmp_path / "file" / "folder",
        "no database": tmp_path / "folder",
    }[what]
    if what == "no database":
        folder.mkdir()
        (folder / "journal.db3").write_text("something else, long enough to be looked at " * 100)
    with pytest.raises(BadFile, match=r"cannot be used as journal: [^\n]+$") as told:
        Journal(folder, print)
    assert "\n" not in str(told.value)


def test_waiting_ends_with_a_row_a_nudge_or_the_time(journal) -> None:
    begin = time.monotonic()
    assert not journal.wait(0, 0.1)
    assert time.monotonic() - begin < 1
    asked = []
    threading.Timer(0.1, lambda: (asked.append(1), journal.nudge())).start()
    assert journal.wait(0, 5, lambda: bool(asked))
    threading.Timer(0.1, lambda: journal.append("/odom", ODOMETRY, message(0))).start()
    assert journal.wait(0, 5)
    assert time.monotonic() - begin < 4
