"""Measurements in the order they were taken, whatever the order they came in.

The watermark is the newest stamp of the source that drives the keyframes, minus the lag; no other source moves
it, since after a stall a node receives loops seconds ahead of odometry. What is older than the watermark is released, ordered by
stamp, then the driving source last (so that all that belongs to a keyframe is there when the keyframe is made), then
source name, then count in the source. What comes after its turn is released at once, marked late; only the
driving source itself, late, is refused: its motion has been used.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from heapq import heappop, heappush

from .command import Command
from .graph import Decision
from .measurement import SECOND, Measurement, StaticTransform, format_stamp

FAR = 1 << 62


def settled(
    items: Iterable[Measurement | Decision], driver: str, lag: int, last_resort: bool = True
) -> Iterator[Measurement | Decision]:
    """Reorder measurements; decisions, and what has no moment of its own, pass through at once.

    driver: the source whose stamps move the watermark. lag: ns. last_resort: release what waits when the input ends.
    """
    waiting: list[tuple[int, bool, str, int, Measurement]] = []
    count: Counter[str] = Counter()
    watermark = -FAR
    for item in items:
        if isinstance(item, Decision | StaticTransform | Command):
            yield item
            continue
        drives = item.source == driver
        if item.stamp < watermark:
            if drives:
                yield _too_late(item, watermark)
            else:
                yield _late(item, watermark)
                yield item
            continue
        count[item.source] += 1
        heappush(waiting, (item.stamp, drives, item.source, count[item.source], item))
        if drives and item.stamp - lag > watermark:
            watermark = item.stamp - lag
            while waiting and waiting[0][0] < watermark:
                yield heappop(waiting)[-1]
    while waiting and last_resort:
        yield heappop(waiting)[-1]


def _late(item: Measurement, watermark: int) -> Decision:
    return Decision(
        item.stamp, f"{item.source}/{format_stamp(item.stamp)}", item.source, "accepted", "settle", "late",
        "came after its turn; taken at its own stamp", (watermark - item.stamp) / SECOND, 0.0,
    )  # fmt: skip


def _too_late(item: Measurement, watermark: int) -> Decision:
    return Decision(
        item.stamp, f"{item.source}/{format_stamp(item.stamp)}", item.source, "refused", "settle", "backward",
        "the driving source went back in time by more than settle.lag", (watermark - item.stamp) / SECOND, 0.0,
    )  # fmt: skip
