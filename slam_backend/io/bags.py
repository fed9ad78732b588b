"""Bags: rosbag1, rosbag2 sqlite3 and mcap, as one stream of records in one order.

The order is (log time, topic, position in the file): equal log times never depend on the storage. Files are
read in parts (chunks) by their own indexes, each part when its time comes, so memory holds only the parts
that overlap. What is damaged is read as far as it goes, and said in `Bag.damage`.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from heapq import heappop, heappush, heapreplace
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from ..core.errors import BadFile
from .qos import offered_qos
from .records import Record
from .storage import open_storage
from .storage.folder import Folder, open_file, read_folder
from .storage.parts import Contents, Part, Row, Source, Topics, inflate, one_line
from .typestore import typestore_of
from .writing import write_bag

__all__ = ["Bag", "Topic", "open_bag", "write_bag"]


@dataclass(frozen=True, slots=True)
class Topic:
    """count: of messages, as the index or a scan tells."""

    type: str
    count: int


def _unpacked(data: bytes, _type: str, _store: Typestore) -> bytes:
    message, whole = inflate(data, "zstd")
    if not whole:
        raise SerdeError("the compressed message is damaged")
    return message


_TO_CDR: Mapping[str, Callable[[bytes, str, Typestore], bytes]] = {
    "cdr": lambda data, _type, _store: data,
    "ros1": lambda data, name, store: bytes(store.ros1_to_cdr(data, name)),
    "cdr.zstd": _unpacked,
}


class Bag:
    """An open bag; use it in a `with` statement."""

    def __init__(self, path: Path, opened: "_Opened", stack: ExitStack) -> None:
        self.path = path
        self._opened, self._stack = opened, stack
        self.connections = [c for content in opened.contents for c in content.connections]
        self._to_cdr = {**_TO_CDR, "cdr": _unpacked} if opened.compressed else _TO_CDR
        self._lost: dict[str, tuple[int, str]] = {}  # topic -> messages left out, why the first one was

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        self._stack.close()

    @cached_property
    def topics(self) -> dict[str, Topic]:
        """By name; of a topic with several types the first that was recorded."""
        counts: Counter[str] = Counter()
        for content in self._opened.contents:
            counts.update(content.counts)
        readable = [c for c in self.connections if c.encoding in _TO_CDR]
        types = {c.topic: c.type for c in reversed(readable)}
        return {name: Topic(types[name], counts[name]) for name in sorted(types)}

    @cached_property
    def qos(self) -> dict[str, str]:
        """By topic: reliability and durability that its publishers offered, the weakest of each; only where the bag says."""
        said = ((c.topic, offered_qos(c.qos)) for c in self.connections if c.qos)
        return {topic: words for topic, words in said if words}

    @property
    def count(self) -> int:
        """Messages of all topics, for progress; a damaged bag may yield fewer."""
        return sum(topic.count for topic in self.topics.values())

    @property
    def damage(self) -> list[str]:
        """One line for each thing that is missing or wrong: file, place, what was lost. Complete after `records`."""
        lines = [*self._opened.damage, *(line for source in self._opened.sources for line in source.damage)]
        for topic, (count, why) in self._lost.items():
            lines.append(f"{self.path}: {one_line(f'{count} messages of {topic} left out: {why}')}")
        return lines or ([] if self.count else [f"{self.path}: holds no messages"])

    @cached_property
    def typestore(self) -> Typestore:
        """Jazzy's message types and those that the bag defines."""
        return typestore_of(self.connections)

    def records(self, topics: Topics = None) -> Iterator[Record]:
        """The messages of `topics` (None: all), in order. Names that are not in the bag yield nothing."""
        self._lost.clear()
        parts = [part for content in self._opened.contents for part in content.parts]
        for log_time, topic, _, connection, message in _in_order(parts, topics):
            convert = self._to_cdr.get(connection.encoding)
            if convert is None:
                self._leave_out(topic, f"the encoding '{connection.encoding}' is not one of ROS")
                continue
            try:
                data = convert(message, connection.type, self.typestore)
            except (SerdeError, ValueError, AssertionError, IndexError) as error:
                self._leave_out(topic, f"the bytes at log time {log_time} ns are damaged ({error})")
                continue
            except KeyError as error:
                self._leave_out(topic, f"the type {error} is not defined")
                continue
            yield Record(topic, connection.type, log_time, data)

    def log_times(self, topics: Topics = None) -> Iterator[tuple[str, int]]:
        """Topic and log time (ns) of each message, in order; nothing is understood of what they hold."""
        for log_time, topic, *_ in _in_order(
            [part for c in self._opened.contents for part in c.parts], topics
        ):
            yield topic, log_time

    def _leave_out(self, topic: str, why: str) -> None:
        count, first = self._lost.get(topic, (0, why))
        self._lost[topic] = (count + 1, first)


def _in_order(parts: Sequence[Part], topics: Topics) -> Iterator[Row]:
    """Merge the parts by (log time, topic, part), opening each when its time comes."""
    waiting = sorted(enumerate(parts), key=lambda part: part[1].start, reverse=True)
    open_parts: list[tuple[int, str, int, Row, Iterator[Row]]] = []
    while waiting or open_parts:
        while waiting and (not open_parts or waiting[-1][1].start <= open_parts[0][0]):
            n, part = waiting.pop()
            rows = part.rows(topics)
            if (first := next(rows, None)) is not None:
                heappush(open_parts, (first[0], first[1], n, first, rows))
        until = waiting[-1][1].start if waiting else None
        while open_parts and (until is None or open_parts[0][0] < until):
            _, _, n, row, rows = open_parts[0]
            yield row
            following = next(rows, None)
            if following is None:
                heappop(open_parts)
            else:
                heapreplace(open_parts, (following[0], following[1], n, following, rows))


class _Opened(NamedTuple):
    """The files of a bag. compressed: each message is. damage: of the folder."""

    contents: Sequence[Contents]
    sources: Sequence[Source]
    compressed: bool
    damage: Sequence[str]


def open_bag(path: Path | str) -> Bag:
    """A rosbag1 file, a rosbag2 folder, or one of its files. BadFile if it is none, or nothing of it can be read."""
    path = Path(path)
    with ExitStack() as stack:
        try:
            if not path.exists():
                raise BadFile(f"{path}: no such file or folder; check the path")
            folder = read_folder(path) if path.is_dir() else Folder((path,), compressed=False, damage=())
            opened = _open_files(folder, stack)
        except OSError as error:
            raise BadFile(f"{path}: cannot be read: {error.strerror or error}") from None
        return Bag(path, opened, stack.pop_all())


def _open_files(folder: Folder, stack: ExitStack) -> _Opened:
    """Every file that can be opened; BadFile if that is none."""
    contents, sources, failed = [], [], []
    for file in folder.files:
        try:
            source = open_file(file, stack)
            contents.append(open_storage(source, stack))
            sources.append(source)
        except BadFile as error:
            failed.append(error)
    if not contents:
        raise failed[0]
    return _Opened(contents, sources, folder.compressed, [*folder.damage, *map(str, failed)])
