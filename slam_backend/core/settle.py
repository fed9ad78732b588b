"""Measurements in the order they were taken, whatever the order they came in.

The watermark is the newest stamp of the source that drives the keyframes, minus the lag; no other source moves
it, since after a stall a node receives loops seconds ahead of odometry. What is older than the watermark is released, ordered by
stamp, then the driving source last (so that all that belongs to a keyframe is there when the keyframe is made), then
source name, then count in the source. What comes after its turn is released at once, marked late; only the
driving source itself, late, is refused: its motion has been used. Of a source of which too many wait, the oldest are dropped.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from heapq import heapify, heappop, heappush

from .command import Command
from .firewall.clock import Clock
from .firewall.continuity import UNBOUND, Pace
from .firewall.rules import MOST_WAITING, decided
from .graph import Decision
from .measurement import SECOND, Constant, Measurement

FAR = 1 << 62


def settled(
    items: Iterable[Measurement | Decision],
    driver: str,
    lag: int,
    last_resort: bool = True,
    ahead: int = FAR,
    passed: Callable[[int], object] = lambda _: None,
    pace: Pace = UNBOUND,
) -> Iterator[Measurement | Decision]:
    """Reorder measurements; decisions, and what has no moment of its own, pass through at once.

    driver: the source whose stamps move the watermark. last_resort: release what waits when the input ends.
    lag: ns. ahead: ns that other sources' stamps may be beyond its newest.
    passed: told the watermark each time it has moved, when all that is older has been taken. pace: of the driving source.
    """
    clock, queue = Clock(lag, pace), _Queue(driver, lag, ahead, passed)
    for item in items:
        if isinstance(item, Decision | Constant | Command):
            yield item
        elif item.source != driver:
            yield from queue.take(item, clock.newest)
        else:
            for each in clock.judge(item):
                if isinstance(each, Decision):
                    yield each
                else:
                    yield from queue.drive(each)
    if last_resort:
        for each in clock.end():
            yield from (each,) if isinstance(each, Decision) else queue.drive(each)
        yield from queue.released(FAR)


class _Queue:
    """What waits for the watermark. lag, ahead: ns."""

    def __init__(self, driver: str, lag: int, ahead: int, passed: Callable[[int], object]) -> None:
        self._driver, self._lag, self._ahead, self._passed = driver, lag, ahead, passed
        self._waiting: list[tuple[int, bool, str, int, Measurement]] = []
        self._count: Counter[str] = Counter()
        self._held: Counter[str] = Counter()
        self._watermark = -FAR

    def take(self, item: Measurement, newest: int | None) -> Iterator[Measurement | Decision]:
        """Of another source than the one that drives, whose newest stamp is given."""
        if item.stamp < self._watermark:
            yield decided(item, "accepted", "settle/late", (self._watermark - item.stamp) / SECOND)
            yield item
        elif newest is not None and item.stamp - newest > self._ahead:
            ahead = (item.stamp - newest) / SECOND
            yield decided(item, "refused", "settle/ahead", ahead, self._ahead / SECOND)
        else:
            self._push(item, drives=False)
            self._held[item.source] += 1
            if self._held[item.source] > MOST_WAITING:
                yield self._drop_half(item.source)

    def drive(self, item: Measurement) -> Iterator[Measurement | Decision]:
        """Of the driving source."""
        if item.stamp < self._watermark:
            yield decided(item, "refused", "settle/backward", (self._watermark - item.stamp) / SECOND)
            return
        self._push(item, drives=True)
        if item.stamp - self._lag > self._watermark:
            self._watermark = item.stamp - self._lag
            yield from self.released(self._watermark)
            self._passed(self._watermark)

    def released(self, until: int) -> Iterator[Measurement]:
        """Take what is older than a stamp, in order."""
        while self._waiting and self._waiting[0][0] < until:
            _, drives, source, _, item = heappop(self._waiting)
            if not drives:
                self._held[source] -= 1
            yield item

    def _push(self, item: Measurement, *, drives: bool) -> None:
        self._count[item.source] += 1
        heappush(self._waiting, (item.stamp, drives, item.source, self._count[item.source], item))

    def _drop_half(self, source: str) -> Decision:
        """The older half of what waits of a source; one decision for all of it."""
        of_source = sorted(each for each in self._waiting if each[2] == source)
        gone = of_source[: len(of_source) // 2]
        dropped = {each[3] for each in gone}
        self._waiting = [each for each in self._waiting if each[2] != source or each[3] not in dropped]
        heapify(self._waiting)
        self._held[source] -= len(gone)
        return decided(gone[0][-1], "refused", "settle/flood", float(len(of_source)), count=len(gone))
