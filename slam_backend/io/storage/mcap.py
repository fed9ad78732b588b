"""mcap: chunks of messages, a summary at the end.

The summary is used when it is whole; a file that was cut, or written without one, is read record by record.
Format: https://mcap.dev/spec
"""

import struct
from collections import Counter
from collections.abc import Iterator
from functools import partial
from io import BytesIO
from struct import Struct
from typing import NamedTuple
from zlib import crc32

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema, Statistics
from rosbags.typesys.msg import normalize_msgtype

from .parts import Connection, Contents, Part, Row, Source, Topics, inflate

MAGIC = b"\x89MCAP0\r\n"
_HEAD = Struct("<BQ")  # of every record: opcode, length
_FOOTER = Struct("<9sQQI8s")  # its head, start of the summary, of the offsets, checksum; magic
_CHUNK = Struct("<QQQII")  # start, end, unpacked size, checksum, length of the compression's name
_MESSAGE = Struct("<HIQQ")  # channel, sequence, log time, publish time
_LOOSE = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}  # what may lie inside chunks or outside
_RUN = 1 << 20  # bytes of loose records that make a part
_UNREADABLE = (struct.error, McapError, KeyError, ValueError)


class _Span(NamedTuple):
    """Where a part lies: the record of a chunk, or a run of loose records."""

    at: int
    end: int
    chunk: bool


class _Bag:
    def __init__(self, source: Source) -> None:
        self.source = source
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Connection] = {}
        self.counts: Counter[str] = Counter()
        self.parts: list[Part] = []

    def contents(self) -> Contents:
        return Contents(tuple(self.channels.values()), self.counts, self.parts)

    def learn(self, opcode: int, body: bytes) -> None:
        """Take up a schema or a channel."""
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(body)))
            self.schemas[schema.id] = schema
            return
        channel = Channel.read(ReadDataStream(BytesIO(body)))
        schema = self.schemas.get(channel.schema_id) or Schema(0, b"", "", "")
        encoding = channel.message_encoding
        self.channels[channel.id] = Connection(
            channel.topic,
            normalize_msgtype(schema.name) if encoding == "ros1" else schema.name,
            encoding,
            schema.encoding,
            schema.data.decode(errors="replace"),  # comments may be in any encoding
            channel.metadata.get("offered_qos_profiles", ""),
        )

    def summary(self) -> bool:
        """Channels, counts and chunks from the summary; False if there is none, or it does not tell all."""
        end = self.source.size - _FOOTER.size
        tail = self.source.read(end, _FOOTER.size) if end > 0 else b""
        if not tail.startswith(_HEAD.pack(Opcode.FOOTER, 20)) or not tail.endswith(MAGIC):
            self.source.say("the end is missing (cut off, or never closed): read without its summary")
            return False
        _, start, _, checksum, _ = _FOOTER.unpack(tail)
        data = self.source.read(start, end - start)
        if not start or (checksum and crc32(data + tail[:-12]) != checksum):
            return False
        try:
            return self.digest(data)
        except _UNREADABLE:
            return False

    def digest(self, data: bytes) -> bool:
        chunks: list[ChunkIndex] = []
        statistics: Statistics | None = None
        at = 0
        while at < len(data):
            opcode, length = _HEAD.unpack_from(data, at)
            body = data[at + _HEAD.size : at + _HEAD.size + length]
            at += _HEAD.size + length
            if opcode in _LOOSE:
                self.learn(opcode, body)
            elif opcode == Opcode.CHUNK_INDEX:
                chunks.append(ChunkIndex.read(ReadDataStream(BytesIO(body))))
            elif opcode == Opcode.STATISTICS:
                statistics = Statistics.read(ReadDataStream(BytesIO(body)))
        if statistics is None or len(self.channels) < statistics.channel_count:
            return False
        if len(chunks) != statistics.chunk_count or (statistics.message_count and not chunks):
            return False
        for channel, count in statistics.channel_message_counts.items():
            self.counts[self.channels[channel].topic] += count
        for c in chunks:
            span = _Span(c.chunk_start_offset, c.chunk_start_offset + c.chunk_length, chunk=True)
            self.parts.append(Part(c.message_start_time, partial(self.rows, span)))
        return True

    def scan(self) -> None:
        """Everything, by reading from the start to where the file ends or breaks off."""
        at = run = len(MAGIC)
        opcode = 0
        while at < self.source.size:
            head = self.source.read(at, _HEAD.size)
            opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
            after = at + _HEAD.size + length
            if opcode in {0, Opcode.DATA_END, Opcode.FOOTER} or (
                after > self.source.size and opcode != Opcode.CHUNK
            ):
                break
            if opcode not in _LOOSE or after - run > _RUN:
                self.take(_Span(run, at, chunk=False))
                run = at if opcode in _LOOSE else after
            if opcode == Opcode.CHUNK:
                self.take(_Span(at, after, chunk=True))
            at = after
        self.take(_Span(run, min(at, self.source.size), chunk=False))
        if opcode not in {Opcode.DATA_END, Opcode.FOOTER}:
            self.source.say(f"breaks off after byte {min(at, self.source.size)}: what followed is lost")

    def take(self, span: _Span) -> None:
        """Make a part of what was scanned, if there are messages in it."""
        rows = list(self.rows(span)) if span.end > span.at else []
        self.counts.update(row[1] for row in rows)
        if rows:
            self.parts.append(Part(rows[0][0], partial(self.rows, span)))

    def rows(self, span: _Span, topics: Topics = None) -> Iterator[Row]:
        rows: list[Row] = []
        whole = False
        try:
            data, whole = self.unpack(span)
            whole = self.walk(data, rows, topics) and whole
        except _UNREADABLE:
            whole = False
        rows.sort()
        if not whole:
            until = f"; {len(rows)} of its messages could be read" if rows else ""
            what = "chunk" if span.chunk else "stretch"
            self.source.say(f"the {what} at byte {span.at} is damaged: its rest is lost{until}")
        return iter(rows)

    def unpack(self, span: _Span) -> tuple[bytes, bool]:
        """The records of a part, and whether they are all there. Of a chunk that fails its checksum: nothing."""
        data = self.source.read(span.at, span.end - span.at)
        if not span.chunk:
            return data, True
        _, _, size, checksum, length = _CHUNK.unpack_from(data, _HEAD.size)
        at = _HEAD.size + _CHUNK.size + length + 8
        unpacked, whole = inflate(data[at:], data[at - 8 - length : at - 8].decode())
        whole = whole and len(unpacked) == size
        if whole and checksum and crc32(unpacked) != checksum:
            return b"", False
        return unpacked, whole

    def walk(self, data: bytes, rows: list[Row], topics: Topics) -> bool:
        """Append the messages among these records; False if they end within one."""
        at, head, message = 0, _HEAD.unpack_from, _MESSAGE.unpack_from
        while at < len(data):
            opcode, length = head(data, at)
            body = at + _HEAD.size
            at = body + length
            if at > len(data):
                return False
            if opcode == Opcode.MESSAGE:
                channel, _, log_time, _ = message(data, body)
                connection = self.channels[channel]
                if topics is None or connection.topic in topics:
                    rows.append(
                        (log_time, connection.topic, len(rows), connection, data[body + _MESSAGE.size : at])
                    )
            elif opcode in _LOOSE:
                self.learn(opcode, data[body:at])
        return True


def open_mcap(source: Source) -> Contents:
    """BadFile if nothing of the file can be read."""
    bag = _Bag(source)
    if not bag.summary():
        bag = _Bag(source)
        bag.scan()
        if source.damage and not bag.channels:
            raise source.bad(
                "the file ends before its first message: nothing can be read; copy or record it again"
            )
    return bag.contents()
