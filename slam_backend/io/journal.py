"""The live node's memory: every record in order of arrival, in an ordinary rosbag2 sqlite3 file.

A callback of the node only appends to a queue; a writer thread of its own commits to SQLite (WAL), many records with one
fsync. Whoever feeds the worker reads the rows back from the file, so that a worker that died is fed again from the
first row, and a slow one fills no memory. Log times are strictly increasing: readers order by them.

A row is acknowledged once it is durable, and only then applied. While the file cannot be written (disk full, read-only, its
folder gone) that is said, records wait in memory and are applied from there, and the file gets them when it can be
written again. What memory cannot hold is neither applied nor kept; a record of the journal's own confesses the gap.
"""

import sqlite3
import threading
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing, suppress
from itertools import islice
from pathlib import Path
from time import time_ns
from typing import NamedTuple

from ..core.config import Journaling
from ..core.errors import BadFile
from . import events
from .events import Event
from .records import Record
from .schema import Entry, connect, insert, open_journal, topics_of
from .storage.sealed import checksum

NAME = "journal.db3"
LIMIT = 200_000  # records that wait in memory while the file cannot be written; what comes then is lost
LIMIT_BYTES = 256 << 20  # of their data
SHARE = 0.75  # of that for topics that are not protected: the rest is the driving source's
TOO_LONG = "the journal could not be written for too long"
RETRY = 1.0  # s between two attempts to write
ROWS = (
    "SELECT m.id, t.name, t.type, m.timestamp, m.data, c.crc32 FROM messages m NOT INDEXED "
    "JOIN topics t ON t.id = m.topic_id LEFT JOIN checksums c ON c.id = m.id WHERE m.id > ? ORDER BY m.id LIMIT ?"
)
HEARD = "SELECT 1 FROM messages m JOIN topics t ON t.id = m.topic_id WHERE t.name != ? LIMIT 1"


class Row(NamedTuple):
    """id: counts from 1 in order of arrival. record: None where the row does not match its checksum."""

    id: int
    record: Record | None


class Journal:
    """Append from any thread; `committed` is the id of the newest row that is acknowledged: on disk, for readers to see.

    heard: whether it holds anything but what it says of itself. lost: records that could not be kept, since there was no room in memory. trouble: why it cannot be
    written just now; empty: it can.
    """

    def __init__(
        self, folder: Path, failed: Callable[[str], None], settings: Journaling | None = None
    ) -> None:
        """Open or continue the journal in a folder. BadFile if it cannot be. failed: told in words when writing begins to fail."""
        self.path = folder / NAME
        self.committed = self.lost = 0
        self.trouble = ""
        self._failed, self._settings = failed, settings or Journaling()
        self._queue: deque[Entry] = deque()
        self._bytes = 0  # of what is queued
        self._full = False  # since the last commit something has been lost, and that was said
        self.protected: Collection[str] = ()  # topics that others must not crowd out
        self._announced: dict[str, str] = {}
        self._gap: tuple[int, int, str] | None = (
            None  # log time of the last record before it, records lost in it, why
        )
        self._arrival = threading.Lock()
        self._wake, self._stop = threading.Event(), threading.Event()
        self._grown = threading.Condition()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._database = open_journal(self.path)
            self.committed, self._newest = self._database.execute(
                "SELECT coalesce(max(id), 0), coalesce(max(timestamp), 0) FROM messages"
            ).fetchone()
            self._topics = topics_of(self._database)
            self.heard = self._database.execute(HEARD, (events.TOPIC,)).fetchone() is not None
            self._file = _identity(self.path)
        except (OSError, sqlite3.Error) as error:
            raise BadFile(f"{self.path}: cannot be used as journal: {error}") from None
        self._appended = self.committed
        self._thread = threading.Thread(target=self._write, name="journal", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Records that are in memory only."""
        return len(self._queue)

    @property
    def ready(self) -> int:
        """Id of the newest row that may be applied: durable, or beyond that in trouble."""
        return self._appended if self.trouble else self.committed

    def append(self, topic: str, type_: str, data: bytes) -> bool:
        """Never blocks. False once the journal is being closed: then nothing is kept."""
        with self._arrival:  # the order of the queue is that of the log times
            if self._stop.is_set():
                return False
            fits = self._has_room(topic, len(data))
            news, self._full = not (fits or self._full), self._full or not fits
            if fits:
                if self._gap is not None:
                    self._confess(self._gap)
                self._enqueue(topic, type_, data)
            else:
                self._lose(1, TOO_LONG)
        if news:
            self._failed(f"{self.path}: memory is full: {topic} is lost; {TOO_LONG}")
        if not self._wake.is_set():  # who was woken looks at the queue after it has cleared this
            self._wake.set()
        return True

    def miss(self, lost: Mapping[str, int], why: str) -> None:
        """Records that were heard and never came here: topic -> how many. The gap is confessed before what comes next."""
        told = ", ".join(f"{n} of {topic}" for topic, n in sorted(lost.items()))
        with self._arrival:
            self._lose(sum(lost.values()), f"{why}: {told}")
        self._failed(f"{self.path}: records are lost: {why}: {told}")

    def note(self, event: Event) -> None:
        """Something that the journal says of itself."""
        self.append(events.TOPIC, events.TYPE, events.encoded(event))

    def announce(self, topics: Mapping[str, str]) -> None:
        """Topics, and a type of each, that are listened to, so that a reader finds them though nothing came."""
        with self._arrival:
            self._announced |= topics
        self._wake.set()

    def wait(self, after: int, timeout: float, unless: Callable[[], bool] = lambda: False) -> bool:
        """Until rows beyond `after` may be applied or, after a nudge, something else is true, or the timeout (s) has passed."""
        with self._grown:
            return self._grown.wait_for(lambda: self.ready > after or unless(), timeout)

    def nudge(self) -> None:
        """Let those who wait look at their `unless`."""
        with self._grown:
            self._grown.notify_all()

    def unwritten(self, after: int, limit: int) -> list[Row]:
        """At most `limit` rows beyond an id that are in memory only; none if the one that follows `after` is not."""
        with self._arrival:
            if not self._queue or self._queue[0][0] > after + 1:
                return []
            begin = after + 1 - self._queue[0][0]
            return [
                Row(id_, Record(topic, type_, log_time, data))
                for id_, topic, type_, log_time, data in islice(self._queue, begin, begin + limit)
            ]

    def close(self, farewell: Event | None = None) -> None:
        """Commit what is queued, and a last word; afterwards the one file holds everything."""
        with self._arrival:
            if farewell is not None and not self._stop.is_set():
                self._enqueue(events.TOPIC, events.TYPE, events.encoded(farewell))
            self._stop.set()
        self._wake.set()
        self._thread.join()

    # -- under the lock of arrival -----------------------------------------------------------------

    def _enqueue(self, topic: str, type_: str, data: bytes) -> None:
        self._newest = max(self._newest + 1, time_ns())
        self._appended += 1
        self.heard |= topic != events.TOPIC
        self._bytes += len(data)
        self._queue.append((self._appended, topic, type_, self._newest, data))

    def _has_room(self, topic: str, size: int) -> bool:
        """What waits may have been applied and must stay: so of a flood the newest are lost, and those of no other source."""
        share = SHARE if self.protected and topic not in self.protected else 1.0
        return len(self._queue) < share * LIMIT and self._bytes + size <= share * LIMIT_BYTES

    def _lose(self, count: int, why: str) -> None:
        self.lost += count
        after, before, _ = self._gap or (self._newest, 0, "")
        self._gap = after, before + count, why

    def _confess(self, gap: tuple[int, int, str]) -> None:
        """Before anything else comes into the queue."""
        self._gap = None
        until = max(self._newest + 1, time_ns())
        self._enqueue(events.TOPIC, events.TYPE, events.encoded(events.gap(gap[0], until, *gap[1:])))

    # -- the writer's thread -----------------------------------------------------------------------

    def _write(self) -> None:
        delay = 0.0 if self._settings.commit == "full" else self._settings.commit_delay
        while not (self._stop.is_set() and not self._queue):
            self._wake.wait()
            self._wake.clear()
            self._stop.wait(delay)
            try:
                self._commit_all()
                self.trouble = ""
            except (sqlite3.Error, OSError) as error:
                self._complain(error)
                if self._stop.wait(RETRY):
                    break
                self._wake.set()
        if self._queue:
            self._failed(f"{self.path}: its last {len(self._queue)} records could not be written")
        with suppress(sqlite3.Error):  # the file and its -wal still hold everything together
            self._database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        self._database.close()

    def _complain(self, error: Exception) -> None:
        news, self.trouble = not self.trouble, f"{self.path}: cannot be written: {error}"
        if news:
            self._failed(f"{self.trouble}; what comes waits in memory")
        self.nudge()  # what waits may be applied

    def _commit_all(self) -> None:
        """All that is queued: at once, or each record by itself."""
        with self._arrival:
            batch = list(self._queue)  # they stay until they are in the file
        size = 1 if self._settings.commit == "full" else max(len(batch), 1)
        for begin in range(0, max(len(batch), 1), size):
            self._commit(batch[begin : begin + size])
        with self._arrival:
            if self._gap is not None:
                self._confess(self._gap)
        if self._queue:
            self._wake.set()

    def _commit(self, batch: Sequence[Entry]) -> None:
        """All or nothing."""
        with self._arrival:
            announced = dict(self._announced)
        if not batch and not announced:
            return
        if _identity(self.path) != self._file:
            self._move_in_again()
        with self._database as database:
            topics = insert(database, self._topics, batch, announced)
        self._topics = topics
        with self._arrival:
            self._announced = {
                name: type_ for name, type_ in self._announced.items() if name not in announced
            }
            for _ in batch:
                self._queue.popleft()
            self._bytes -= sum(len(data) for *_, data in batch)
            self._full = False
        with self._grown:
            self.committed += len(batch)
            self._grown.notify_all()

    def _move_in_again(self) -> None:
        """The file has vanished: it is back (a disk mounted again), or what was in it is written anew, from the open file."""
        if self.path.exists():
            with closing(connect(self.path, "ro")) as other:
                if other.execute("SELECT max(id) FROM messages").fetchone() != (self.committed,):
                    raise OSError("another file has taken its place: move that away")
            there = connect(self.path, "rw")
        else:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            there = connect(self.path, "rwc")
            try:
                self._database.backup(there)
            except sqlite3.Error:
                there.close()
                self.path.unlink()  # nothing of it is whole
                raise
        self._database.close()
        self._database, self._file = there, _identity(self.path)
        self._failed(f"{self.path}: had vanished; it is there again, with all that it held")


class JournalReader:
    """Rows in order of arrival, while the journal is being written; for one thread."""

    def __init__(self, path: Path) -> None:
        """sqlite3.Error if there is none."""
        self._database = connect(path, "rw")

    def after(self, id_: int, limit: int) -> list[Row]:
        """At most `limit` committed rows beyond an id."""
        return [
            Row(n, Record(*record) if crc == checksum(*record) else None)
            for n, *record, crc in self._database.execute(ROWS, (id_, limit))
        ]

    def close(self) -> None:
        self._database.close()


def _identity(path: Path) -> tuple[int, int] | None:
    """Of the file that is at this place; None if there is none."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino
