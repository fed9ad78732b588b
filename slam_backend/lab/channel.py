"""The way from the sensors to the back-end: messages are lost, late or doubled, and arrive in one order."""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from numpy.random import Generator

from ..core.measurement import SECOND, ImuSample, Measurement
from ..core.sensors.gnss import Fix
from ..core.sensors.landmark import LandmarkObservation
from ..core.sensors.odometry import OdometryPose
from ..core.sensors.pixels import PixelFrame
from ..core.sensors.relative import RelativePose
from .options import Options

Content = OdometryPose | RelativePose | Fix | ImuSample | PixelFrame | tuple[LandmarkObservation, ...]
ECHO = 1_000_000  # ns from a message to its duplicate


class Sent(NamedTuple):
    """A message on its way: `arrival` in ns, never earlier than its stamp."""

    arrival: int
    topic: str
    content: Content

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        return self.content if isinstance(self.content, tuple) else (self.content,)


def delivered(
    messages: Iterable[Sent], start: int, options: Options, rng: Generator, count: Callable[[str], None]
) -> Iterator[Sent]:
    """What arrives of sensor messages; `count` hears 'silent', 'dropped', 'late' or 'duplicated' once per message."""
    silence = start + round(options.silence_start * SECOND)
    silent = range(silence, silence + round(options.silence * SECOND))
    for message in messages:
        drop, late, double = rng.random(3)  # always three: what happens to one message changes no other
        if message.measurements[0].stamp in silent:
            count("silent")
            continue
        if drop < options.dropout:
            count("dropped")
            continue
        arrival = message.arrival
        if late < options.late:
            count("late")
            arrival += round(options.late_delay * SECOND)
        yield message._replace(arrival=arrival)
        if double < options.duplicated:
            count("duplicated")
            yield message._replace(arrival=arrival + ECHO)


def in_order(messages: Iterable[Sent]) -> tuple[Sent, ...]:
    """By arrival; equal arrivals are moved apart by a nanosecond, since log times in a bag must grow."""
    ordered, last = [], 0
    for message in sorted(messages, key=lambda sent: sent.arrival):
        last = max(message.arrival, last + 1)
        ordered.append(message._replace(arrival=last))
    return tuple(ordered)
