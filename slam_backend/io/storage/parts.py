"""What every storage format is reduced to: connections, and parts of a file that can be read one by one."""

import bz2
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Protocol

import lz4.frame  # type: ignore[import-untyped]  # ships no types
import zstandard

from ...core.errors import BadFile


class Connection(NamedTuple):
    """A topic as the file announces it.

    encoding: `cdr`, `ros1`, or `cdr.zstd` where each message is compressed; anything else cannot be read.
    schema: `ros2msg`, `ros1msg`, `ros2idl`, or empty where the file holds no definition.
    qos: what its publishers offered, as rosbag2 writes it (YAML); empty where the file does not say.
    """

    topic: str
    type: str
    encoding: str = "cdr"
    schema: str = ""
    definition: str = ""
    qos: str = ""


Row = tuple[int, str, int, Connection, bytes]  # log time, topic, position in the part, connection, message
Topics = Collection[str] | None  # None: all


class Part(NamedTuple):
    """A stretch of a file; `rows` reads it in order of (log time, topic, position). No row is earlier than `start`."""

    start: int
    rows: Callable[[Topics], Iterator[Row]]


class Contents(NamedTuple):
    """A file, opened. `counts`: messages per topic."""

    connections: Sequence[Connection]
    counts: Mapping[str, int]
    parts: Sequence[Part]


def one_line(text: str) -> str:
    """Names and errors that come out of damaged bytes may hold anything."""
    return " ".join(text.split())


class Source:
    """A file that is read at any place; beyond its end there is simply nothing. Collects what is wrong with it."""

    def __init__(self, path: Path, name: str | None = None) -> None:
        """name: what to call it in messages, when `path` is a temporary copy."""
        self.path = path
        self.name = name or str(path)
        self.damage: list[str] = []
        try:
            self._file = path.open("rb")
            self.size = path.stat().st_size
        except OSError as error:
            raise BadFile(f"{self.name}: cannot be opened: {error.strerror}") from None

    def read(self, at: int, size: int) -> bytes:
        """At most `size` bytes from `at` on."""
        try:
            self._file.seek(at)
            return self._file.read(max(0, min(size, self.size - at)))
        except OSError as error:
            self.say(f"cannot be read from byte {at} on: {error.strerror}")
            return b""

    def say(self, line: str) -> None:
        """Record damage: the place, and what was lost. Said once, however often it is met."""
        if (line := f"{self.name}: {one_line(line)}") not in self.damage:
            self.damage.append(line)

    def bad(self, what: str) -> BadFile:
        return BadFile(f"{self.name}: {one_line(what)}")

    def close(self) -> None:
        self._file.close()


class _Decompressor(Protocol):
    @property
    def eof(self) -> bool: ...

    def decompress(self, data: bytes, /) -> bytes: ...


_DECOMPRESSORS: Mapping[str, Callable[[], _Decompressor]] = {
    "zstd": lambda: zstandard.ZstdDecompressor().decompressobj(),
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "bz2": bz2.BZ2Decompressor,
}


def inflate(data: bytes, compression: str) -> tuple[bytes, bool]:
    """What can be decompressed, and whether that is all of it. A cut stream gives what comes before the cut."""
    if compression in {"", "none"}:
        return data, True
    if compression not in _DECOMPRESSORS:
        return b"", False
    decompressor = _DECOMPRESSORS[compression]()
    pieces: list[bytes] = []
    # a decompressor that stumbles returns nothing of that call: small calls lose little
    with suppress(zstandard.ZstdError, RuntimeError, OSError, ValueError, EOFError, MemoryError):
        for at in range(0, len(data), 1 << 16):
            if decompressor.eof:
                break
            pieces.append(decompressor.decompress(data[at : at + (1 << 16)]))
    return b"".join(pieces), decompressor.eof
