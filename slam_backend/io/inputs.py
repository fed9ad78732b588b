"""What a run reads: bags, in order of arrival, or one pose graph, as if live."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from difflib import get_close_matches
from heapq import merge
from itertools import repeat
from pathlib import Path
from typing import Protocol, Self

from ..core import command
from ..core.config import Config
from ..core.errors import BadConfig, BadFile
from ..core.graph import Decision
from ..core.measurement import Measurement
from ..core.sensors import SENSORS
from . import events
from .bags import Bag, Topic, open_bag
from .cdr import DECODERS, Decoder
from .formats import endings, read_graph
from .formats.posegraph import PERIOD, PoseGraph, measurements
from .records import Record

EDGES, LANDMARKS = "edges", "landmarks"  # the sources of a graph file, when the configuration names none
TF_STATIC = "/tf_static"
OWN: Mapping[str, tuple[str, str]] = {  # topic -> (source, kind) of what is read without being configured
    TF_STATIC: (TF_STATIC, "static"),
    command.TOPIC: ("command", "command"),
    events.TOPIC: ("journal", "session"),
}

Stream = Iterator[Measurement | Decision]


class Inputs(Protocol):
    """count: records or measurements to come, for progress. read: how many have been read."""

    count: int
    read: int

    @property
    def paths(self) -> Sequence[Path]: ...

    @property
    def damage(self) -> list[str]:
        """One line for each thing wrong with the files; complete at the end of the stream."""
        ...

    def stream(self, config: Config) -> Stream:
        """Measurements in order of arrival. BadConfig where the configuration asks for what is not there."""
        ...

    def vertex(self, stamp: int) -> int | None:
        """The id of a graph file's vertex with that stamp; None for other inputs."""
        ...

    def close(self) -> None: ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


class _Closing:
    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Nothing is held open."""


class BagInputs(_Closing):
    """Several bags are one: merged by log time."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = paths
        self.read = 0
        with ExitStack() as stack:
            self.bags: list[Bag] = [stack.enter_context(open_bag(path)) for path in paths]
            self._stack = stack.pop_all()
        self.count = sum(bag.count for bag in self.bags)

    @property
    def topics(self) -> dict[str, Topic]:
        return {name: topic for bag in reversed(self.bags) for name, topic in bag.topics.items()}

    @property
    def damage(self) -> list[str]:
        return [line for bag in self.bags for line in bag.damage]

    def stream(self, config: Config) -> Stream:
        table = self._table(config)
        self.count = sum(
            topic.count for name, topic in self.topics.items() if name in table and name != events.TOPIC
        )
        decoders = [Decoder(bag.typestore, table) for bag in self.bags]
        for record, n in self._records(set(table)):
            self.read += not events.is_own(record)
            yield from decoders[n].decode(record)

    def _records(self, topics: Collection[str]) -> Iterator[tuple[Record, int]]:
        """In order of log time, each with the number of its bag."""
        tagged = [zip(bag.records(topics), repeat(n)) for n, bag in enumerate(self.bags)]
        if len(tagged) == 1:
            return tagged[0]
        return merge(*tagged, key=lambda pair: (pair[0].log_time, pair[0].topic))

    def log_times(self, topics: Collection[str]) -> Iterator[tuple[str, int]]:
        """Topic and log time (ns) of each message, bag after bag, whatever the messages hold."""
        for bag in self.bags:
            yield from bag.log_times(topics)

    @property
    def qos(self) -> dict[str, str]:
        """What the publishers of a topic offered, where a bag says it."""
        return {name: words for bag in reversed(self.bags) for name, words in bag.qos.items()}

    def vertex(self, stamp: int) -> int | None:  # noqa: ARG002  # a bag has no vertices
        return None

    def close(self) -> None:
        self._stack.close()

    def _table(self, config: Config) -> dict[str, tuple[str, str]]:
        """Topic -> (source, kind) of what the configuration wants, each checked against what is there."""
        topics = self.topics
        table: dict[str, tuple[str, str]] = {}
        where = ", ".join(str(path) for path in self.paths)
        for name, topic in (
            (name, topic) for name, source in config.sources.items() for topic in source.topics
        ):
            if topic not in topics:
                what = f"no topic '{topic}' in {where}" if topic else "states no topic"
                raise BadConfig(f"source '{name}': {what}{_instead(topic, topics)}")
            kind, has = config.sources[name].kind, topics[topic].type
            if has not in SENSORS[kind].decoders:
                takes = ", ".join(SENSORS[kind].decoders)
                raise BadConfig(
                    f"source '{name}': {topic} in {where} is {has}; a source of kind '{kind}' takes {takes}"
                )
            if topic in table:
                raise BadConfig(
                    f"source '{name}': topic '{topic}' belongs to source '{table[topic][0]}' already"
                )
            table[topic] = (name, kind)
        own = {topic: row for topic, row in OWN.items() if topic in topics}
        return table | {topic: row for topic, row in own.items() if topics[topic].type in DECODERS[row[1]]}


class GraphInput(_Closing):
    """A pose graph file, its vertices in order of their ids, one period apart."""

    def __init__(self, path: Path) -> None:
        self.paths = [path]
        self.graph: PoseGraph = read_graph(path)
        if not len(self.graph.edges):
            raise BadFile(f"{path}: holds no edges between poses: nothing to optimize")
        self.count = (
            len(self.graph.edges) + len(self.graph.sightings) + int(self.graph.ranges.to_landmark.sum())
        )
        self.read = 0

    def vertex(self, stamp: int) -> int | None:
        rank = stamp // PERIOD - 1
        return int(self.graph.ids[rank]) if stamp % PERIOD == 0 and 0 <= rank < len(self.graph.ids) else None

    @property
    def damage(self) -> list[str]:
        left = [f"left out: {what}; vertex by vertex they have no place" for what in self.graph.timeless]
        return [f"{self.paths[0]}: {note}" for note in (*self.graph.notes, *left)]

    def stream(self, config: Config) -> Stream:
        edges = next((name for name, s in config.sources.items() if s.kind == "relative"), None)
        if edges is None or edges != config.driver:
            raise BadConfig(
                f"{self.paths[0]} is a pose graph: configure a source of kind relative and none of kind odometry"
            )
        sightings = next((name for name, s in config.sources.items() if s.kind == "landmark"), LANDMARKS)
        if self.graph.sees_landmarks and sightings not in config.sources:
            raise BadConfig(f"{self.paths[0]} holds landmarks: configure a source of kind landmark")
        for measurement in measurements(self.graph, edges, sightings):
            self.read += 1
            yield measurement


def open_inputs(paths: Sequence[Path | str]) -> BagInputs | GraphInput:
    """Bags, or one pose graph file. BadFile names what cannot be read."""
    found = [Path(path) for path in paths]
    if not found:
        raise BadFile("no input: name a bag, a journal or a pose graph")
    graphs = [path for path in found if path.name.lower().endswith(endings("graph"))]
    if not graphs:
        return BagInputs(found)
    if len(found) > 1:
        raise BadFile(f"{graphs[0]}: a pose graph is replayed alone, not together with other inputs")
    return GraphInput(graphs[0])


def _instead(topic: str, topics: Mapping[str, Topic]) -> str:
    close = get_close_matches(topic, topics, n=1)
    if close:
        return f"; did you mean '{close[0]}'?"
    some = ", ".join(f"{name} ({each.type})" for name, each in list(topics.items())[:12])
    return f"; there are {some}" if some else "; it holds no topics"
