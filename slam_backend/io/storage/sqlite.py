"""rosbag2 sqlite3: the tables `topics`, `messages`, `message_definitions`.

A database that was cut off cannot be opened as it is: its whole pages are copied to a temporary file and read
by row number until SQLite complains. One with a write-ahead log or a rollback journal beside it is still in
use, or was left by a crash: it is read with them. Journals of the node vouch for their rows (sealed.py).
"""

import shutil
import sqlite3
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from .parts import Connection, Contents, Part, Row, Source, Topics
from .sealed import UNREADABLE, is_sealed, rows_of
from .wal import torn

MAGIC = b"SQLite format 3\0"
COUNTS = "SELECT topic_id, count(*) FROM messages GROUP BY topic_id"


class _Bag:
    def __init__(self, source: Source, database: sqlite3.Connection) -> None:
        self.source, self.database = source, database
        self.topics = self._topics()
        self.counts: Counter[str] = Counter()
        self.stray: int | None = None  # the first row that is no message

    def _topics(self) -> dict[int, Connection]:
        """By row; names that are damaged are replaced, for what they are worth."""
        definitions: dict[str, tuple[str, str]] = {}
        if self.database.execute("PRAGMA table_info(message_definitions)").fetchall():
            definitions = {
                str(name): (str(encoding), str(text))
                for name, encoding, text in self.database.execute(
                    "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
                )
            }
        return {
            identity: Connection(
                str(topic), str(kind), str(encoding), *definitions.get(kind, ("", "")), qos=str(qos or "")
            )
            for identity, topic, kind, encoding, qos in self.database.execute(
                f"SELECT id, name, type, serialization_format, {self._offered()} FROM topics"  # noqa: S608
            )
        }

    def _offered(self) -> str:
        """The column of QoS profiles, which the oldest schema lacks."""
        columns = {row[1] for row in self.database.execute("PRAGMA table_info(topics)")}
        return "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"

    def row(self, identity: int, topic: int, log_time: object, data: object) -> Row | None:
        """A row of the table, or None if it does not hold a message."""
        connection = self.topics.get(topic)
        if connection is None or not isinstance(log_time, int) or not isinstance(data, bytes):
            self.stray = identity if self.stray is None else self.stray
            self.source.say(f"row {self.stray} of the table holds no message: left out, and all like it")
            return None
        return log_time, connection.topic, identity, connection, data

    def sealed(self) -> Contents:
        """All messages by row number, each judged by its checksum."""
        try:
            for topic, count in self.database.execute(COUNTS):
                if topic in self.topics:
                    self.counts[self.topics[topic].topic] += count
        except UNREADABLE as error:
            self.source.say(f"the database is damaged: {error}")
        parts = [Part(0, lambda topics: rows_of(self.database, self.source, self.topics, topics))]
        return Contents(tuple(self.topics.values()), self.counts, parts)

    def indexed(self) -> Contents:
        """All messages in order of time, by the index of the table."""
        for topic, count in self.database.execute(COUNTS):
            if topic in self.topics:
                self.counts[self.topics[topic].topic] += count
            else:
                self.source.say(f"{count} rows belong to no topic: left out")
        (start,) = self.database.execute("SELECT min(timestamp) FROM messages").fetchone()
        parts = [] if start is None else [Part(start, self.rows)]
        return Contents(tuple(self.topics.values()), self.counts, parts)

    def rows(self, topics: Topics) -> Iterator[Row]:
        wanted = [n for n, connection in self.topics.items() if topics is None or connection.topic in topics]
        query = (
            "SELECT id, topic_id, timestamp, data FROM messages "  # noqa: S608  # only question marks are put in
            f"WHERE topic_id IN ({','.join('?' * len(wanted))}) ORDER BY timestamp, id"
        )
        same: list[Row] = []  # rows with equal log times, to be ordered by topic
        last = None
        try:
            for found in _all_of(self.database, query, wanted):
                row = self.row(*found)
                if row is None:
                    continue
                if same and row[0] != same[0][0]:
                    yield from sorted(same)
                    same.clear()
                same.append(row)
                last = row[0]
        except UNREADABLE as error:
            place = "the first message" if last is None else f"log time {last} ns"
            self.source.say(f"cannot be read beyond {place}: {error}; the rest is lost")
        yield from sorted(same)

    def recovered(self) -> Contents:
        """What can be read by row number, then put in order of time."""
        found: list[tuple[int, str, int]] = []
        try:
            for identity, topic, log_time, data in _all_of(
                self.database, "SELECT id, topic_id, timestamp, data FROM messages ORDER BY id"
            ):
                row = self.row(identity, topic, log_time, data)
                if row is not None:
                    found.append(row[:3])
        except UNREADABLE as error:
            self.source.say(
                f"rows after {found[-1][2] if found else 0} cannot be read: {error}; they are lost"
            )
        self.counts.update(topic for _, topic, _ in found)
        found.sort()
        parts = [Part(found[0][0], lambda topics: self.fetch(found, topics))] if found else []
        return Contents(tuple(self.topics.values()), self.counts, parts)

    def fetch(self, found: list[tuple[int, str, int]], topics: Topics) -> Iterator[Row]:
        query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id = ?"
        for _, topic, identity in found:
            if topics is not None and topic not in topics:
                continue
            try:
                answer = self.database.execute(query, (identity,)).fetchone()
            except UNREADABLE as error:
                answer = None
                self.source.say(f"some rows that were there cannot be fetched: {error}; they are lost")
            row = self.row(*(answer or (identity, 0, None, None)))
            if row is not None:
                yield row


def _all_of(database: sqlite3.Connection, query: str, arguments: Sequence[int] = ()) -> Iterator[Any]:
    """The rows of a query; before the error of one that cannot be read the last whole one, to which Python has looked ahead."""
    n = 0
    try:
        for n, row in enumerate(database.execute(query, arguments), 1):  # noqa: B007  # how many there were
            yield row
    except UNREADABLE:
        with suppress(*UNREADABLE):
            yield from database.execute(f"{query} LIMIT 1 OFFSET {n}", arguments).fetchall()
        raise


def _connect(path: Path, how: str, stack: ExitStack) -> sqlite3.Connection:
    database = sqlite3.connect(f"{path.absolute().as_uri()}?{how}", uri=True)
    database.text_factory = lambda raw: raw.decode(errors="replace")
    stack.callback(database.close)
    return database


def _beside(path: Path) -> list[Path]:
    """The logs of unfinished transactions that lie beside a database."""
    names = (path.with_name(path.name + ending) for ending in ("-wal", "-journal"))
    return [log for log in names if log.is_file() and log.stat().st_size]


def _whole_pages(source: Source, folder: Path) -> Path:
    """A copy without the last, partial page: SQLite would read its missing end as zeros."""
    page = int.from_bytes(source.read(16, 2), "big")
    page = 65536 if page == 1 else max(page, 512)
    copy = folder / "recovered.db3"
    shutil.copyfile(source.path, copy)
    with copy.open("r+b") as file:
        file.truncate(source.size // page * page)
    return copy


def _is_cut(source: Source) -> bool:
    """Whether the file is shorter than its own header says."""
    header = source.read(0, 100)
    page, pages = int.from_bytes(header[16:18], "big"), int.from_bytes(header[28:32], "big")
    stated = header[24:28] == header[92:96]  # else the page count is not to be trusted
    return len(header) < 100 or (stated and source.size < pages * (65536 if page == 1 else page))


def _contents(source: Source, database: sqlite3.Connection) -> Contents:
    bag = _Bag(source, database)
    return bag.sealed() if is_sealed(database, source) else bag.indexed()


def _open_logged(source: Source, logs: list[Path], stack: ExitStack) -> Contents:
    if lost := torn(source.path.with_name(f"{source.path.name}-wal")):
        source.say(lost)
    try:  # a database in use is read where it lies
        return _contents(source, _connect(source.path, "mode=ro", stack))
    except UNREADABLE:  # what a crash left needs writing before it can be read: on a copy
        folder = Path(stack.enter_context(TemporaryDirectory()))
        for file in (source.path, *logs):
            shutil.copyfile(file, folder / file.name)
        return _contents(source, _connect(folder / source.path.name, "mode=rw", stack))


def _recover(source: Source, why: str, stack: ExitStack) -> Contents:
    source.say(f"the database is damaged ({why}): read row by row as far as it goes")
    copy = _whole_pages(source, Path(stack.enter_context(TemporaryDirectory())))
    database = _connect(copy, "mode=ro", stack)
    database.execute("PRAGMA writable_schema=ON")  # opens a file that is shorter than its header says
    bag = _Bag(source, database)
    return bag.sealed() if is_sealed(database, source) else bag.recovered()


def open_sqlite(source: Source, stack: ExitStack) -> Contents:
    """BadFile if nothing of the database can be read. `stack` closes what was opened."""
    try:
        if logs := _beside(source.path):
            return _open_logged(source, logs, stack)
        if _is_cut(source):
            return _recover(source, "cut off", stack)
        try:
            return _contents(source, _connect(source.path, "immutable=1", stack))
        except UNREADABLE as error:
            if "no such" in str(error):  # a database of something else
                raise
            return _recover(source, str(error), stack)
    except (*UNREADABLE, OSError) as error:
        raise source.bad(f"not a readable rosbag2 database: {error}; copy or record it again") from None
