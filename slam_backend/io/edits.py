"""edits.jsonl: what was done to a run after its end, one command to a line, in order.

With the inputs and config.yaml it is all that an edited run follows from: its files are written by a replay of the inputs, at
whose end these commands are carried out. One line may stand before them, of the action `without`: the measurements, by their
number in order of arrival, that the replay is to leave out as if they had never been.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ..core.check import checked
from ..core.command import Command, command, parse, text_of
from ..core.config import Config
from ..core.errors import BadFile, BadMessage
from ..core.graph import Decision, identify
from ..core.measurement import Constant, Measurement
from ..core.sensors.odometry import OdometryPose
from .formats.lines import read_text

NAME = "edits.jsonl"
WITHOUT = "without"
Items = Iterable[Measurement | Decision]
Settled = Callable[[Items, Config], Iterator[Measurement | Decision]]  # the way to the back-end


@dataclass(frozen=True, slots=True)
class Edits:
    """dropped: numbers of measurements, from 0 in order of arrival, and the ids they had. commands: at the end."""

    dropped: Mapping[int, str] = field(default_factory=dict)
    commands: tuple[Command, ...] = ()

    def __len__(self) -> int:
        return bool(self.dropped) + len(self.commands)


NONE = Edits()


def read_edits(path: Path) -> Edits:
    """None where there is no such file. BadFile names a line that makes no sense."""
    if not path.exists():
        return NONE
    dropped: dict[int, str] = {}
    commands = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        try:
            asked = parse(line)
            if asked.action == WITHOUT:
                dropped |= {int(n): str(id_) for n, id_ in asked.arguments["measurements"].items()}
            else:
                commands.append(asked)
        except (BadMessage, LookupError, AttributeError, ValueError) as error:
            raise BadFile(f"{path}:{number}: is damaged: {error}") from None
    return Edits(dropped, tuple(commands))


def write_edits(path: Path, edits: Edits) -> None:
    """No file where there is nothing to write."""
    if not edits:
        path.unlink(missing_ok=True)
        return
    numbers = {str(n): id_ for n, id_ in sorted(edits.dropped.items())}
    first = (command("0", WITHOUT, {"measurements": numbers}),) if numbers else ()
    path.write_text("".join(f"{text_of(each)}\n" for each in (*first, *edits.commands)), encoding="utf-8")


def kept(items: Items, dropped: Collection[int]) -> Iterator[Measurement | Decision]:
    """All but the measurements with these numbers."""
    if not dropped:
        yield from items
        return
    for n, item in _numbered(items):
        if n not in dropped:
            yield item


def arrivals(
    items: Items, config: Config, dropped: Collection[int], ids: Collection[str], settled: Settled
) -> dict[str, int]:
    """The numbers of the measurements that have these ids in a run without those that are dropped; those that can be told.

    A measurement gets its id behind the firewall, in the order of stamps; so the stream goes that way, and nothing is solved.
    """
    wanted = {id_.rpartition("/")[0] for id_ in ids}
    numbers: dict[int, tuple[int, Measurement]] = {}  # by the identity of what comes out of the check

    def watched() -> Iterator[Measurement | Decision]:
        for n, item in _numbered(items):
            for out in () if n in dropped else checked((item,), config):
                if isinstance(out, Measurement) and identify(out, 0).rpartition("/")[0] in wanted:
                    numbers[id(out)] = (n, out)
                yield out

    counts: Counter[tuple[str, int]] = Counter()
    found = {}
    for item in settled(watched(), config):
        if isinstance(item, Decision | Constant | Command | OdometryPose):
            continue
        name = identify(item, counts[item.source, item.stamp])
        counts[item.source, item.stamp] += 1
        if name in ids and id(item) in numbers:
            found[name] = numbers[id(item)][0]
    return found


def without(id_: str, dropped: Collection[str]) -> str:
    """What an id becomes when some measurements of the same source and stamp are gone."""
    head, _, tail = id_.rpartition("/")
    n, colon, which = tail.partition(":")
    before = sum(
        1 for each in dropped if each.rpartition("/")[0] == head and int(each.rpartition("/")[2]) < int(n)
    )
    return f"{head}/{int(n) - before}{colon}{which}"


def _numbered(items: Items) -> Iterator[tuple[int, Measurement | Decision]]:
    """-1 for what is no measurement."""
    n = 0
    for item in items:
        if isinstance(item, Measurement):
            yield n, item
            n += 1
        else:
            yield -1, item
