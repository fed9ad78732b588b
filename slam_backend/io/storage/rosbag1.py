"""rosbag1, format 2.0: chunks of messages, an index of chunks at the end.

The index is used when it is whole; a bag that was cut or never closed is read chunk by chunk, as far as it goes.
Format: https://wiki.ros.org/Bags/Format/2.0
"""

import struct
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from struct import Struct
from typing import NamedTuple

from rosbags.typesys.msg import normalize_msgtype

from ...core.measurement import SECOND
from .parts import Connection, Contents, Part, Row, Source, Topics, inflate

MAGIC = b"#ROSBAG V"
_VERSION = b"#ROSBAG V2.0\n"
_MESSAGE, _HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_U32, _U64, _PAIR = Struct("<I").unpack_from, Struct("<Q").unpack_from, Struct("<II").unpack_from

Read = Callable[[int, int], bytes]  # (place, size) -> at most size bytes


class _Entry(NamedTuple):
    """One record of the file: its op, header fields, and where its data lies."""

    op: int
    fields: dict[bytes, bytes]
    at: int
    size: int

    @property
    def end(self) -> int:
        return self.at + self.size

    def time(self, name: bytes) -> int:
        seconds, nanoseconds = _PAIR(self.fields[name])
        return int(seconds) * SECOND + int(nanoseconds)


class _Broken(Exception):
    """The bytes do not follow the format."""


def _fields(header: bytes) -> dict[bytes, bytes]:
    fields, at = {}, 0
    while at < len(header):
        (size,) = _U32(header, at)
        name, equals, value = header[at + 4 : at + 4 + size].partition(b"=")
        at += 4 + size
        if not equals or at > len(header):
            raise _Broken
        fields[name] = value
    return fields


def _entry(read: Read, at: int) -> _Entry:
    """The record that begins at `at`; its data may reach beyond the end. _Broken if none begins there."""
    try:
        (length,) = _U32(read(at, 4))
        header = read(at + 4, length)
        (size,) = _U32(read(at + 4 + length, 4))
        fields = _fields(header)
        return _Entry(fields[b"op"][0], fields, at + 8 + length, size)
    except (struct.error, KeyError, IndexError):
        raise _Broken from None


class _Bag:
    def __init__(self, source: Source) -> None:
        self.source = source
        self.connections: dict[int, Connection] = {}
        self.counts: Counter[str] = Counter()
        self.parts: list[Part] = []

    def contents(self) -> Contents:
        return Contents(tuple(self.connections.values()), self.counts, self.parts)

    def index(self, header: _Entry) -> None:
        """Connections and chunks from the index at the end; _Broken if it is not whole."""
        at = int(_U64(header.fields[b"index_pos"])[0])
        if at < header.end:
            raise _Broken
        connections, chunks = (int(_U32(header.fields[name])[0]) for name in (b"conn_count", b"chunk_count"))
        for n in range(connections + chunks):
            entry = _entry(self.source.read, at)
            at = entry.end
            data = self.source.read(entry.at, entry.size)
            if len(data) < entry.size or entry.op != (_CONNECTION if n < connections else _CHUNK_INFO):
                raise _Broken
            if entry.op == _CONNECTION:
                self.connect(entry, data)
            else:
                self.announce(entry, data)

    def connect(self, entry: _Entry, data: bytes) -> None:
        fields = _fields(data)
        self.connections[_U32(entry.fields[b"conn"])[0]] = Connection(
            entry.fields[b"topic"].decode(),
            normalize_msgtype(fields[b"type"].decode()),
            "ros1",
            "ros1msg",
            fields[b"message_definition"].decode(errors="replace"),  # comments may be in any encoding
        )

    def announce(self, entry: _Entry, data: bytes) -> None:
        """A chunk, as the index describes it."""
        for n in range(_U32(entry.fields[b"count"])[0]):
            identity, count = _PAIR(data, 8 * n)
            self.counts[self.connections[identity].topic] += count
        place, start = int(_U64(entry.fields[b"chunk_pos"])[0]), entry.time(b"start_time")
        self.parts.append(Part(start, partial(self.rows, place)))

    def scan(self, at: int) -> None:
        """Connections and chunks by reading everything from `at` to where the file breaks off."""
        while at < self.source.size:
            try:
                entry = _entry(self.source.read, at)
            except _Broken:
                break
            if entry.op == _CHUNK:
                rows = list(self.rows(at))
                self.counts.update(row[1] for row in rows)
                if rows:
                    self.parts.append(Part(rows[0][0], partial(self.rows, at)))
            if entry.end > self.source.size:
                break
            at = entry.end
        self.source.say(
            f"the index at the end is missing (cut off, or never closed): read up to byte {at}, the rest is lost"
        )

    def rows(self, place: int, topics: Topics = None) -> Iterator[Row]:
        """The messages of the chunk whose record begins at `place`."""
        rows: list[Row] = []
        whole = False
        try:
            chunk = _entry(self.source.read, place)
            data, whole = inflate(
                self.source.read(chunk.at, chunk.size), chunk.fields[b"compression"].decode(errors="replace")
            )
            whole = self.walk(data, rows, topics) and whole and len(data) == _U32(chunk.fields[b"size"])[0]
        except (_Broken, struct.error, KeyError, UnicodeDecodeError):
            whole = False
        rows.sort()
        if not whole:
            until = f"; {len(rows)} of its messages could be read" if rows else ""
            self.source.say(f"the chunk at byte {place} is damaged: its rest is lost{until}")
        return iter(rows)

    def walk(self, data: bytes, rows: list[Row], topics: Topics) -> bool:
        """Append the messages of an unpacked chunk; False if it ends within a record."""
        at = 0
        while at < len(data):
            entry = _entry(lambda place, size: data[place : place + size], at)
            at = entry.end
            if at > len(data):
                return False
            if entry.op == _CONNECTION:
                self.connect(entry, data[entry.at : at])
            elif entry.op == _MESSAGE:
                connection = self.connections[_U32(entry.fields[b"conn"])[0]]
                if topics is None or connection.topic in topics:
                    message = data[entry.at : at]
                    rows.append((entry.time(b"time"), connection.topic, len(rows), connection, message))
        return True


def open_rosbag1(source: Source) -> Contents:
    """BadFile if nothing of the bag can be read."""
    if source.read(0, len(_VERSION)) != _VERSION:
        raise source.bad("not format 2.0 of rosbag1; `rosbag fix` on a ROS 1 machine converts older ones")
    try:
        header = _entry(source.read, len(_VERSION))
    except _Broken:
        header = _Entry(0, {}, 0, 0)
    if header.op != _HEADER or header.end > source.size:
        raise source.bad("the bag ends within its header: nothing can be read; copy or record it again")
    if header.fields.get(b"encryptor"):
        raise source.bad("the bag is encrypted; decrypt it with rosbag first")
    bag = _Bag(source)
    try:
        bag.index(header)
    except (_Broken, struct.error, KeyError, UnicodeDecodeError):
        bag = _Bag(source)
        bag.scan(header.end)
    return bag.contents()
