"""The live node's memory: every record in order of arrival, in an ordinary rosbag2 sqlite3 file.

A callback of the node only appends to a queue; a writer thread of its own commits to SQLite (WAL), many records at a
time. Whoever feeds the worker reads the rows back from the file, so that a worker that died is fed again from the
first row, and a slow one fills no memory. Log times are strictly increasing: readers order by them. A file that cannot
be written (disk full) is tried again every second, while records wait in memory.
"""

import sqlite3
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from time import time_ns
from typing import NamedTuple

from ..core.errors import BadFile
from .records import Record
from .typestore import typestore_of

NAME = "journal.db3"
COMMIT_DELAY = 0.05  # s that a record may wait for others before it is committed
LIMIT = 200_000  # records that wait in memory while the file cannot be written; what comes then is lost
RETRY = 1.0  # s between two attempts to write
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
UNANNOUNCE = "DELETE FROM topics WHERE name = ? AND id NOT IN (SELECT DISTINCT topic_id FROM messages)"


class Row(NamedTuple):
    """id: counts from 1 in order of arrival."""

    id: int
    record: Record


class Journal:
    """Append from any thread; `committed` is the id of the newest row that readers can see.

    lost: records that could not be kept, since the file could not be written for long. trouble: why it cannot be
    written just now; empty: it can.
    """

    def __init__(self, folder: Path, failed: Callable[[str], None]) -> None:
        """Open or continue the journal in a folder. BadFile if it cannot be. failed: told in words when writing begins to fail."""
        self.path = folder / NAME
        self.committed = self.lost = 0
        self.trouble = ""
        self._failed = failed
        self._queue: deque[tuple[str, str, int, bytes]] = deque()
        self._announced: dict[str, str] = {}
        self._arrival = threading.Lock()
        self._wake, self._stop = threading.Event(), threading.Event()
        self._grown = threading.Condition()
        self._newest = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._database = _connect(self.path, "rwc")
            with self._database as database:
                database.executescript(SCHEMA)
                database.execute("INSERT OR IGNORE INTO schema VALUES (4, 'jazzy')")
                self.committed, self._newest = database.execute(
                    "SELECT coalesce(max(id), 0), coalesce(max(timestamp), 0) FROM messages"
                ).fetchone()
        except (OSError, sqlite3.Error) as error:
            raise BadFile(f"{self.path}: cannot be used as journal: {error}") from None
        self._thread = threading.Thread(target=self._write, name="journal", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Records that are in memory only."""
        return len(self._queue)

    def append(self, topic: str, type_: str, data: bytes) -> bool:
        """Never blocks. False once the journal is being closed: then nothing is kept."""
        with self._arrival:  # the order of the queue is that of the log times
            if self._stop.is_set():
                return False
            if len(self._queue) >= LIMIT:
                self.lost += 1
                return True
            self._newest = max(self._newest + 1, time_ns())
            self._queue.append((topic, type_, self._newest, data))
        self._wake.set()
        return True

    def announce(self, topics: Mapping[str, str]) -> None:
        """Topics, and a type of each, that are listened to, so that a reader finds them though nothing came."""
        self._announced |= topics
        self._wake.set()

    def wait(self, after: int, timeout: float, unless: Callable[[], bool] = lambda: False) -> bool:
        """Until there are rows beyond `after` or, after a nudge, something else is true, or the timeout (s) has passed."""
        with self._grown:
            return self._grown.wait_for(lambda: self.committed > after or unless(), timeout)

    def nudge(self) -> None:
        """Let those who wait look at their `unless`."""
        with self._grown:
            self._grown.notify_all()

    def close(self) -> None:
        """Commit what is queued; afterwards the one file holds everything."""
        with self._arrival:
            self._stop.set()
        self._wake.set()
        self._thread.join()

    def _write(self) -> None:
        database = self._database
        topics = _topics(database)
        while not (self._stop.is_set() and not self._queue):
            self._wake.wait()
            self._wake.clear()
            self._stop.wait(COMMIT_DELAY)
            batch = [self._queue[n] for n in range(len(self._queue))]  # they stay until they are in the file
            try:
                topics = self._commit(database, topics, batch)
                self.trouble = ""
            except sqlite3.Error as error:
                news, self.trouble = not self.trouble, f"{self.path}: cannot be written: {error}"
                if news:
                    self._failed(f"{self.trouble}; what comes waits in memory")
                if self._stop.wait(RETRY):
                    break
                self._wake.set()
        if self._queue:
            self._failed(f"{self.path}: its last {len(self._queue)} records could not be written")
        with suppress(sqlite3.Error):  # the file and its -wal still hold everything together
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        database.close()

    def _commit(
        self,
        database: sqlite3.Connection,
        topics: Mapping[tuple[str, str], int],
        batch: Sequence[tuple[str, str, int, bytes]],
    ) -> dict[tuple[str, str], int]:
        """All or nothing; the ids of the topics that the file has then."""
        known, announced = dict(topics), dict(self._announced)
        with database:
            for name, type_ in dict.fromkeys((name, type_) for name, type_, _, _ in batch):
                if (name, type_) not in known:
                    database.execute(UNANNOUNCE, (name,))
                    known = _topics(database) | {(name, type_): _add_topic(database, name, type_)}
            for name, type_ in announced.items():
                if not any(name == there for there, _ in known):
                    known[name, type_] = _add_topic(database, name, type_)
            rows = [(known[name, type_], stamp, data) for name, type_, stamp, data in batch]
            database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
        for _ in batch:
            self._queue.popleft()
        with self._grown:
            self.committed += len(batch)
            self._grown.notify_all()
        return known


class JournalReader:
    """Rows in order of arrival, while the journal is being written; for one thread."""

    def __init__(self, path: Path) -> None:
        """sqlite3.Error if there is none."""
        self._database = _connect(path, "rw")

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


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    """mode: rw, or rwc to create it."""
    database = sqlite3.connect(f"{path.absolute().as_uri()}?mode={mode}", uri=True, check_same_thread=False)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("PRAGMA synchronous=NORMAL")
    return database


def _topics(database: sqlite3.Connection) -> dict[tuple[str, str], int]:
    return {(name, type_): id_ for id_, name, type_ in database.execute("SELECT id, name, type FROM topics")}


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
