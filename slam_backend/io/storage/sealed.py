"""The rows of a journal: a bag with a checksum of each record in a side table. Read by id, and every row is judged.

The pages of SQLite have no checksums: a flipped bit may change a message, hide rows, or put them out of order, without a
word. Here a row counts only if it matches its checksum and follows the one before; what is missing in between is said.
"""

import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from typing import Any
from zlib import crc32

from .parts import Connection, Row, Source, Topics

VERSION = 1  # of the journal's own tables, as PRAGMA user_version; 0: journals without checksums
UNREADABLE = (sqlite3.Error, UnicodeDecodeError)  # the latter when the schema itself is damaged


def checksum(topic: str, type_: str, log_time: int, data: bytes) -> int:
    """CRC-32 of a record."""
    return crc32(data, crc32(b"%d" % log_time, _of_names(topic, type_)))


@lru_cache(maxsize=1024)
def _of_names(topic: str, type_: str) -> int:
    return crc32(f"{topic}\0{type_}\0".encode())


def is_sealed(database: sqlite3.Connection, source: Source) -> bool:
    """Whether the database is a journal with checksums."""
    (version,) = database.execute("PRAGMA user_version").fetchone()
    if database.execute("PRAGMA table_info(checksums)").fetchall():
        return True
    if version == VERSION:
        source.say("the table of checksums is missing: nothing vouches for its records")
    return False


def rows_of(
    database: sqlite3.Connection, source: Source, connections: Mapping[int, Connection], topics: Topics
) -> Iterator[Row]:
    """The whole records of `topics`, in order; the others are not looked at."""
    last, missing = 0, _Missing()
    wanted = {id_ for id_, known in connections.items() if topics is None or known.topic in topics}
    for id_, topic, log_time, data, crc in _scan(database, source, wanted):
        connection = connections.get(topic)
        if connection is None or id_ <= last or crc is None:
            continue
        if topic in wanted and not _matches(connection, log_time, data, crc):
            continue
        missing.between(last, id_)
        last = id_
        if topic in wanted:
            yield log_time, connection.topic, id_, connection, data
    missing.between(last, _end(database) + 1)
    missing.say(source)


def _matches(connection: Connection, log_time: object, data: object, crc: object) -> bool:
    if not isinstance(log_time, int) or not isinstance(data, bytes):
        return False
    return crc == checksum(connection.topic, connection.type, log_time, data)


def _scan(database: sqlite3.Connection, source: Source, wanted: set[int]) -> Iterator[Any]:
    """Rows by id: id, topic, log time, data (none of topics that are not wanted), checksum. Beyond a damaged page it goes on."""
    query = (
        "SELECT m.id, m.topic_id, m.timestamp, "  # noqa: S608  # only question marks are put in
        f"CASE WHEN m.topic_id IN ({','.join('?' * len(wanted))}) THEN m.data END, c.crc32 "
        "FROM messages m NOT INDEXED LEFT JOIN checksums c ON c.id = m.id WHERE m.id "
    )
    end, at, step = _end(database), 0, 1
    whole = False
    while not whole and at <= end:
        try:
            for row in database.execute(f"{query} > ? ORDER BY m.id", (*wanted, at)):
                at, step = row[0], 1
                yield row
            whole = True
        except UNREADABLE as error:
            source.say(f"the database is damaged: {error}")
            if step == 1:  # Python has looked ahead, and not told of the row before the damage
                with suppress(*UNREADABLE):
                    yield from database.execute(f"{query} = ?", (*wanted, at + 1)).fetchall()
            at, step = at + step, 2 * step


def _end(database: sqlite3.Connection) -> int:
    """The id of the newest row that is known of."""
    for query in ("SELECT max(id) FROM checksums", "SELECT max(id) FROM messages"):
        with suppress(*UNREADABLE):
            return int(database.execute(query).fetchone()[0] or 0)
    return 0


class _Missing:
    """Stretches of rows that are not there, or not whole."""

    def __init__(self) -> None:
        self._stretches: list[str] = []
        self._count = 0

    def between(self, last: int, next_: int) -> None:
        if next_ > last + 1:
            self._count += next_ - last - 1
            self._stretches.append(f"{last + 1}" if next_ == last + 2 else f"{last + 1} to {next_ - 1}")

    def say(self, source: Source) -> None:
        if self._count:
            some = ", ".join(self._stretches[:10]) + (", ..." if len(self._stretches) > 10 else "")
            source.say(f"{self._count} records are missing or damaged, and left out: rows {some}")
