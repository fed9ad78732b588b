"""The live node's memory: every record in order of arrival, in an ordinary rosbag2 sqlite3 file.

A callback of the node only appends to a queue; a writer thread of its own commits to SQLite (WAL), many records at a
time. Whoever feeds the worker reads the rows back from the file, so that a worker that died is fed again from the
first row, and a slow one fills no memory. Log times are strictly increasing: readers order by them.
"""

import sqlite3
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from time import time_ns
from typing import NamedTuple

from ..core.errors import BadFile
from .records import Record
from .typestore import typestore_of

NAME = "journal.db3"
COMMIT_DELAY = 0.05  # s that a record may wait for others before it is committed
SCHEMA = """
CREATE TABLE IF NOT EXISTS schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
    serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
    encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
    data BLOB NOT NULL);
CREATE INDEX IF NOT EXISTS timestamp_idx ON messages(timestamp ASC);
"""


class Row(NamedTuple):
    """id: counts from 1 in order of arrival."""

    id: int
    record: Record


class Journal:
    """Append from any thread; `committed` is the id of the newest row that readers can see."""

    def __init__(self, folder: Path, failed: Callable[[str], None]) -> None:
        """Open or continue the journal in a folder. BadFile if it cannot be. failed: told once, in words, when writing fails."""
        self.path = folder / NAME
        self.committed = 0
        self._failed = failed
        self._queue: deque[tuple[str, str, int, bytes]] = deque()
        self._wake, self._stop = threading.Event(), threading.Event()
        self._grown = threading.Condition()
        self._newest = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with _connect(self.path) as database:
                database.executescript(SCHEMA)
                database.execute("INSERT OR IGNORE INTO schema VALUES (4, 'jazzy')")
                self.committed, self._newest = database.execute(
                    "SELECT coalesce(max(id), 0), coalesce(max(timestamp), 0) FROM messages"
                ).fetchone()
        except (OSError, sqlite3.Error) as error:
            raise BadFile(f"{self.path}: cannot be used as journal: {error}") from None
        self._thread = threading.Thread(target=self._write, name="journal", daemon=True)
        self._thread.start()

    def append(self, topic: str, type_: str, data: bytes) -> None:
        """Never blocks."""
        self._newest = max(self._newest + 1, time_ns())
        self._queue.append((topic, type_, self._newest, data))
        self._wake.set()

    def wait(self, after: int, timeout: float) -> bool:
        """Until there are rows beyond `after`, or the timeout (s) has passed."""
        with self._grown:
            return self._grown.wait_for(lambda: self.committed > after, timeout)

    def close(self) -> None:
        """Commit what is queued."""
        self._stop.set()
        self._wake.set()
        self._thread.join()

    def _write(self) -> None:
        database = _connect(self.path)
        topics = {
            (name, type_): id_ for id_, name, type_ in database.execute("SELECT id, name, type FROM topics")
        }
        while not (self._stop.is_set() and not self._queue):
            self._wake.wait()
            self._wake.clear()
            self._stop.wait(COMMIT_DELAY)
            batch = [self._queue.popleft() for _ in range(len(self._queue))]
            try:
                self._commit(database, topics, batch)
            except sqlite3.Error as error:
                self._queue.extendleft(reversed(batch))
                self._failed(f"{self.path}: cannot be written: {error}")
                self._stop.wait(1.0)
                if self._stop.is_set():
                    break
                self._wake.set()
        database.close()

    def _commit(
        self,
        database: sqlite3.Connection,
        topics: dict[tuple[str, str], int],
        batch: list[tuple[str, str, int, bytes]],
    ) -> None:
        with database:
            for name, type_, _, _ in batch:
                if (name, type_) not in topics:
                    topics[name, type_] = _add_topic(database, name, type_)
            rows = [(topics[name, type_], stamp, data) for name, type_, stamp, data in batch]
            database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
        with self._grown:
            self.committed += len(batch)
            self._grown.notify_all()


class JournalReader:
    """Rows in order of arrival, while the journal is being written; for one thread."""

    def __init__(self, path: Path) -> None:
        self._database = _connect(path)

    def after(self, id_: int, limit: int) -> list[Row]:
        """At most `limit` committed rows beyond an id."""
        found = self._database.execute(
            "SELECT m.id, t.name, t.type, m.timestamp, m.data FROM messages m JOIN topics t ON t.id = m.topic_id "
            "WHERE m.id > ? ORDER BY m.id LIMIT ?",
            (id_, limit),
        )
        return [Row(row[0], Record(*row[1:])) for row in found]

    def close(self) -> None:
        self._database.close()


def _connect(path: Path) -> sqlite3.Connection:
    database = sqlite3.connect(path, check_same_thread=False)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("PRAGMA synchronous=NORMAL")
    return database


def _add_topic(database: sqlite3.Connection, name: str, type_: str) -> int:
    """A row of `topics`, and the definition of its type, so that the journal explains itself."""
    store = typestore_of(())
    digest = ""
    if type_ in store.fielddefs:
        digest = store.hash_rihs01(type_)
        text, _ = store.generate_msgdef(type_, ros_version=2)
        known = database.execute(
            "SELECT 1 FROM message_definitions WHERE topic_type = ?", (type_,)
        ).fetchone()
        if not known:
            database.execute(
                "INSERT INTO message_definitions(topic_type, encoding, encoded_message_definition, type_description_hash) "
                "VALUES (?, 'ros2msg', ?, ?)",
                (type_, text, digest),
            )
    cursor = database.execute(
        "INSERT INTO topics(name, type, serialization_format, offered_qos_profiles, type_description_hash) "
        "VALUES (?, ?, 'cdr', '', ?)",
        (name, type_, digest),
    )
    assert cursor.lastrowid is not None
    return cursor.lastrowid
