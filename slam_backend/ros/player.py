"""Plays a bag: its bytes, untouched, to real topics, at the pace of its log times.

A DDS queue that is full drops its oldest message without a word. So the player keeps count of what its receivers have
not acknowledged and waits for them rather than overwrite it; and whoever held it up, it goes on at its pace afterwards
instead of hurrying after the lost time. What a receiver's own queue drops, nobody tells the sender.
"""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from itertools import chain
from struct import pack
from time import monotonic, sleep
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.typesys.store import Typestore

from ..core.measurement import SECOND
from ..io.bags import Bag
from ..io.records import Record
from ..io.typestore import typestore_of

CLOCK = "/clock"
TICK = 0.01  # s between two messages on /clock
FASTEST = 1000.0  # messages/s at rate 0: what a receiver written in Python takes without losing any
MATCHING = 0.3  # s from our seeing a receiver until it sees us
LOOK, FULL = 0.1, 0.75  # parts of the queue from which we ask for acknowledgement, and wait for it
PATIENCE = 25.0  # s until DDS itself gives up a receiver that says nothing (20 s), and some more


@dataclass(slots=True)
class _Output:
    """A topic that is played. pending: messages that may not be acknowledged yet."""

    name: str
    kind: str
    publisher: Any
    pending: int = 0


class Player:
    """Publishers for what can be played of a bag; use it in a `with` statement.

    topics: name in the bag -> name to play it to. depth: of the queues. clock: publish /clock too.
    """

    def __init__(
        self, bag: Bag, topics: Mapping[str, str], depth: int = 2000, *, clock: bool = False
    ) -> None:
        self.played: Counter[str] = Counter()  # by the name played to
        self.skipped: list[str] = []  # a line for each topic that cannot be played, and why
        self._depth = depth
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context)  # a context of its own leaves the signals to Python
        self._node = rclpy.create_node(
            "bag_player", context=self._context, enable_rosout=False, start_parameter_services=False
        )
        self._clock = self._publisher("rosgraph_msgs/msg/Clock", CLOCK, 1) if clock else None
        self._told = 0.0  # by our own clock, when /clock was published last
        self._outputs = {
            topic: output for topic in topics if (output := self._open(bag, topic, topics[topic]))
        }
        self.count = sum(bag.topics[topic].count for topic in self._outputs)
        records = bag.records(set(self._outputs))
        first = next(records, None)
        self._begin = first.log_time if first else 0
        self._records: Iterable[Record] = chain([first], records) if first else ()

    def __enter__(self) -> "Player":
        return self

    def __exit__(self, *_: object) -> None:
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def wait_for_receivers(self, seconds: float) -> list[str]:
        """Wait until every topic has one; give the names of those that still have none after that time."""
        until = monotonic() + seconds
        while lonely := [o.name for o in self._outputs.values() if not o.publisher.get_subscription_count()]:
            self._tell_time(self._begin)  # who runs on simulated time may need it to get going
            if monotonic() >= until:
                break
            sleep(TICK)
        self._tell_time(self._begin)
        sleep(MATCHING)
        return lonely

    def play(self, rate: float = 1.0) -> Iterator[Record]:
        """Publish, and give each record once it is out. rate: times the recorded speed; 0: at FASTEST, whatever the log times."""
        pace = _Pace(rate, self._begin)
        for n, record in enumerate(self._records):
            while (left := pace.left(n, record.log_time)) > 0:
                sleep(min(left, max(self._told + TICK - monotonic(), 0)) if self._clock else left)
                self._tell_time(min(pace.now(record.log_time), record.log_time))
            self._tell_time(record.log_time)
            output = self._outputs[record.topic]
            if record.type != output.kind:
                self._leave_out(record, output)
                continue
            pace.begin += self._make_room(output)
            output.publisher.publish(record.data)
            output.pending += 1
            self.played[output.name] += 1
            yield record

    def finish(self, seconds: float = PATIENCE) -> list[str]:
        """Wait until all is acknowledged; give the names of topics where it is not after that time."""
        until = monotonic() + seconds
        for output in self._outputs.values():
            while not _acknowledged(output, TICK) and monotonic() < until:
                pass
        return [output.name for output in self._outputs.values() if output.pending]

    def _open(self, bag: Bag, topic: str, name: str) -> _Output | None:
        kind = bag.topics[topic].type
        why = _trouble(kind, bag.typestore)
        if self._clock and name == CLOCK:
            why = "the player publishes its own"
        if not why:
            try:
                return _Output(name, kind, self._publisher(kind, name, self._depth))
            except InvalidTopicNameException:
                why = f"'{name}' is no topic name in ROS 2; give it another with --remap"
            except RuntimeError as error:  # RCLError: another topic of another type is played to that name
                why = str(error).partition(", at /")[0]
        self.skipped.append(f"{topic} ({kind}): {why}")
        return None

    def _leave_out(self, record: Record, output: _Output) -> None:
        line = f"{record.topic}: messages of {record.type} among those of {output.kind} are left out"
        if line not in self.skipped:
            self.skipped.append(line)

    def _publisher(self, kind: str, name: str, depth: int) -> Any:
        latched = name.endswith("/tf_static")
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        profile = QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
        return self._node.create_publisher(message_class(kind), name, profile)

    def _make_room(self, output: _Output) -> float:
        """Seconds that we had to wait until the receivers had acknowledged enough."""
        if output.pending < LOOK * self._depth or _acknowledged(output, 0):
            return 0.0
        begin = monotonic()
        while output.pending >= FULL * self._depth and not _acknowledged(output, TICK):
            pass
        return monotonic() - begin

    def _tell_time(self, log_time: int) -> None:
        if self._clock and monotonic() >= self._told + TICK:
            self._told = monotonic()
            self._clock.publish(b"\0\1\0\0" + pack("<iI", *divmod(log_time, SECOND)))


class _Pace:
    """When what is due by our own clock. begin: when the first record was, later by all that held us up."""

    def __init__(self, rate: float, log_begin: int) -> None:
        self.begin = monotonic()
        self._rate, self._log_begin = rate, log_begin

    def left(self, n: int, log_time: int) -> float:
        """Seconds until the n-th record is due, logged then; never much below zero: time lost is not made up for."""
        at = n / FASTEST if self._rate == 0 else (log_time - self._log_begin) / SECOND / self._rate
        left = self.begin + at - monotonic()
        if left < -TICK:
            self.begin -= left
        return left

    def now(self, log_time: int) -> int:
        """The log time that it is now; at rate 0 it jumps to that of the record."""
        if self._rate == 0:
            return log_time
        return self._log_begin + int((monotonic() - self.begin) * self._rate * SECOND)


def _acknowledged(output: _Output, seconds: float) -> bool:
    """Whether all that was published is, within that time."""
    if output.pending and output.publisher.wait_for_all_acked(Duration(seconds=seconds)):
        output.pending = 0
    return not output.pending


def message_class(kind: str) -> Any:
    """The class for `nav_msgs/msg/Odometry`; None if this ROS does not have it."""
    package, _, name = kind.partition("/msg/")
    if not re.fullmatch(r"[a-z]\w*/[A-Z]\w*", f"{package}/{name}", re.ASCII):
        return None
    try:
        found = getattr(import_module(f"{package}.msg"), name, None)
    except ImportError:
        return None
    return found if hasattr(found, "get_fields_and_field_types") else None


def _trouble(kind: str, of_bag: Typestore) -> str:
    """Why messages of this type cannot be played; empty if they can."""
    if message_class(kind) is None:
        return "this ROS does not have the type"
    jazzy = _jazzy()
    if (
        kind in jazzy.fielddefs
        and kind in of_bag.fielddefs
        and jazzy.hash_rihs01(kind) != of_bag.hash_rihs01(kind)
    ):
        return "the bag defines the type otherwise, and receivers would misread it"
    return ""


@cache
def _jazzy() -> Typestore:
    return typestore_of(())
