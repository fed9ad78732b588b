"""The tables of a journal: those of rosbag2's sqlite3 storage, and beside them a checksum of each record."""

import os
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path

from .storage.sealed import VERSION, checksum
from .typestore import typestore_of

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
CREATE TABLE IF NOT EXISTS checksums(id INTEGER PRIMARY KEY, crc32 INTEGER NOT NULL);
INSERT OR IGNORE INTO schema VALUES (4, 'jazzy');
"""
SEAL = (
    "INSERT INTO checksums SELECT m.id, checksum(t.name, t.type, m.timestamp, m.data) "
    "FROM messages m JOIN topics t ON t.id = m.topic_id ORDER BY m.id"
)
UNANNOUNCE = "DELETE FROM topics WHERE name = ? AND id NOT IN (SELECT DISTINCT topic_id FROM messages)"

MANY = 50  # rows in one statement: each costs a way through SQLite's machine, and through the GIL
MESSAGE = "INSERT INTO messages VALUES (?, ?, ?, ?)"
CHECKSUM = "INSERT INTO checksums VALUES (?, ?)"

Entry = tuple[
    int, str, str, int, bytes
]  # a record and the id of its row: id, topic, type, log time (ns), data
Topics = dict[tuple[str, str], int]  # (name, type) -> id of its row


def connect(path: Path, mode: str) -> sqlite3.Connection:
    """mode: ro; rw; rwc to create it. A commit returns when it is durable: in WAL mode NORMAL would not wait for the disk."""
    database = sqlite3.connect(f"{path.absolute().as_uri()}?mode={mode}", uri=True, check_same_thread=False)
    if mode != "ro":
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("PRAGMA synchronous=FULL")
    return database


def open_journal(path: Path) -> sqlite3.Connection:
    """Create or continue it; one from before there were checksums gets them. sqlite3.Error or OSError if that cannot be."""
    is_new = not path.exists()
    database = connect(path, "rwc")
    (version,) = database.execute("PRAGMA user_version").fetchone()
    if version > VERSION:
        raise sqlite3.DatabaseError("a newer version of slam_backend has written it")
    database.create_function("checksum", 4, checksum, deterministic=True)
    with database:
        database.executescript(f"BEGIN; {SCHEMA}")
        if version < VERSION:
            database.execute(SEAL)
            database.execute(f"PRAGMA user_version={VERSION}")
    if is_new:
        sync(path.parent)  # SQLite syncs the folder for its logs, not for the database itself
    return database


def sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def topics_of(database: sqlite3.Connection) -> Topics:
    return {(name, type_): id_ for id_, name, type_ in database.execute("SELECT id, name, type FROM topics")}


def insert(
    database: sqlite3.Connection, topics: Topics, batch: Iterable[Entry], announced: Mapping[str, str]
) -> Topics:
    """In the transaction that is open. topics: that the file has; returns those that it has then."""
    known, rows, sums = dict(topics), [], []
    for id_, name, type_, log_time, data in batch:
        topic = known.get((name, type_))
        if topic is None:
            database.execute(UNANNOUNCE, (name,))
            topic = _add_topic(database, name, type_)
            known = topics_of(database)
        rows.append((id_, topic, log_time, data))
        sums.append((id_, checksum(name, type_, log_time, data)))
    for name, type_ in announced.items():
        if not any(name == there for there, _ in known):
            known[name, type_] = _add_topic(database, name, type_)
    _fill(database, MESSAGE, rows)
    _fill(database, CHECKSUM, sums)
    return known


def _fill(database: sqlite3.Connection, one: str, rows: Sequence[tuple[object, ...]]) -> None:
    """one: the statement for one row. In groups of the same size, so that SQLite has each statement prepared already."""
    whole = len(rows) - len(rows) % MANY
    many = one + f", {one.partition('VALUES ')[2]}" * (MANY - 1)
    for begin in range(0, whole, MANY):
        database.execute(many, tuple(chain.from_iterable(rows[begin : begin + MANY])))
    database.executemany(one, rows[whole:])


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
