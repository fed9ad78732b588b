"""Measurements on their way: for a keyframe that covers them, or for a variable that they need."""

from array import array
from bisect import bisect_left
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from heapq import heappop, heappush
from itertools import islice

from .config import Config
from .errors import BadConfig
from .firewall.rules import MOST_WAITING, decided
from .graph import UNTIL_JOINED, Decision, Offer, Wait, identify
from .measurement import Measurement, parse_stamp

REMEMBERED = (
    1 << 20
)  # stamps of each source at which a measurement with the same stamp is still counted on; 12 MB
MOST_IMAGES = 100  # images between two keyframes that are remembered as places for the next one


class Waiting:
    """All that has been offered and is not in the graph yet."""

    def __init__(self, config: Config) -> None:
        self._sources, self._driver = config.sources, config.driver
        self._pending: list[Offer] = []
        self._asked: list[int] = []  # stamps at which a source wants a keyframe
        self._images: deque[int] = deque(maxlen=MOST_IMAGES)  # stamps of images
        self._undetermined: dict[int, list[Wait]] = defaultdict(list)
        self._reasons: dict[int, str] = {}  # why something waited last, by the variable that it waits for
        self._waits = 0  # ever
        self._tallies: dict[str, _Tally] = defaultdict(_Tally)
        self.late: Mapping[str, int] = {}  # ns that are added to the stamps of a source

    def __bool__(self) -> bool:
        return bool(self._pending)

    @property
    def newest(self) -> int:
        """Stamp of what was offered last."""
        return self._pending[-1].measurement.stamp

    def offer(self, measurement: Measurement) -> list[Decision]:
        """A measurement gets its id: the source, the stamp, and how many of that source had the same stamp before.

        Of a source that floods, the older half is dropped; the decision about it is returned.
        """
        source = self._sources.get(measurement.source)
        if source is None:
            raise BadConfig(f"there is no source '{measurement.source}'; known: {', '.join(self._sources)}")
        n = self._tallies[measurement.source].count(measurement.stamp)
        self._pending.append(Offer(identify(measurement, n), measurement))
        if getattr(source, "keyframe", False):
            for stamp in measurement.ends or (measurement.stamp,):
                heappush(self._asked, stamp)
        elif source.kind == "pixels":
            self._images.append(measurement.stamp)
        return [] if len(self._pending) % MOST_WAITING else self._relieved()

    def _relieved(self) -> list[Decision]:
        """Looks at all that is pending; for once in a great many offers."""
        gone, decisions = _older_halves([o for o in self._pending if o.measurement.source != self._driver])
        self._pending = [offer for offer in self._pending if offer.id not in gone]
        return decisions

    def again(self, offers: list[Offer]) -> None:
        """What could not land this time."""
        self._pending += offers

    def wants(self, until: int) -> bool:
        """Whether a keyframe is wanted at a stamp up to `until`."""
        return bool(self._asked) and self._asked[0] <= until

    def asked(self, until: int) -> list[int]:
        """Take the stamps up to `until` at which keyframes are wanted, in order."""
        stamps = []
        while self.wants(until):
            stamps.append(heappop(self._asked))
        return stamps

    def image(self, after: int, until: int) -> int | None:
        """The newest stamp of an image that lies after one stamp and not after another: where a keyframe is best made."""
        return max((stamp for stamp in self._images if after < stamp <= until), default=None)

    def window(self, until: int) -> list[Offer]:
        """Take what lands at a keyframe with this stamp, late measurements included."""
        return self._take(lambda m: m.stamp + self.late.get(m.source, 0) <= until)

    def of(self, source: str) -> list[Offer]:
        """Take all that one source has offered."""
        return self._take(lambda measurement: measurement.source == source)

    def _take(self, wanted: Callable[[Measurement], bool]) -> list[Offer]:
        taken: list[Offer] = []
        kept: list[Offer] = []
        for offer in self._pending:
            (taken if wanted(offer.measurement) else kept).append(offer)
        self._pending = kept
        return taken

    def wait(self, wait: Wait) -> list[Decision]:
        """Keep a measurement until its variable exists. Of a source of which too many wait in vain, the older half is dropped."""
        self._undetermined[wait.until].append(wait)
        self._reasons[wait.until] = wait.reason
        m = wait.offer.measurement
        told = Decision(
            m.stamp, wait.offer.id, m.source, "probation", "wait", "undetermined", wait.reason, ends=m.ends
        )
        self._waits += 1
        return [told] if self._waits % MOST_WAITING else [told, *self._despaired()]

    def _despaired(self) -> list[Decision]:
        """Looks at all that wait for a variable; for once in a great many."""
        waits = [wait.offer for waits in self._undetermined.values() for wait in waits]
        waits.sort(key=lambda offer: offer.measurement.stamp)
        gone, decisions = _older_halves(waits)
        for until, those in self._undetermined.items():
            self._undetermined[until] = [wait for wait in those if wait.offer.id not in gone]
        return decisions

    def wake(self, key: int) -> None:
        """A variable exists now, or parts were joined: what waited for it is offered again."""
        self._pending += [wait.offer for wait in self._undetermined.pop(key, ())]
        self._reasons.pop(key, None)

    def for_variable(self, key: int) -> Sequence[Wait]:
        """What waits for it."""
        return self._undetermined.get(key, ())

    def why(self, key: int) -> str:
        """What was said last of a variable that something waited for, even when the input has ended; empty if nothing did."""
        return self._reasons.get(key, "")

    def landed(self, keys: Iterable[int], ids: Collection[str]) -> list[Offer]:
        """Of what waited for these variables, the measurements that make them: they wait no longer."""
        taken = []
        for key in keys:
            if waits := self._undetermined.get(key):
                taken += [wait.offer for wait in waits if wait.offer.id in ids]
                self._undetermined[key] = [wait for wait in waits if wait.offer.id not in ids]
        return taken

    def for_a_joint(self) -> list[Wait]:
        """What waits until two parts become one."""
        return self._undetermined.get(UNTIL_JOINED, [])

    def used(self, waits: Collection[Wait]) -> None:
        """They wait no longer for a joint."""
        left = [wait for wait in self.for_a_joint() if wait not in waits]
        self._undetermined[UNTIL_JOINED] = left

    def remember(self, ids: Iterable[str]) -> None:
        """Ids that are taken: what is offered later gets others."""
        for id_ in ids:
            source, stamp, n = id_.split("/")
            self._tallies[source].remember(parse_stamp(stamp), int(n.partition(":")[0]))

    def leftovers(self) -> list[Decision]:
        """At the end of the input: refuse what no keyframe ever covered, and what waited in vain."""
        decisions = [
            refusal(each, "backend", "uncovered", "no trajectory at its stamp") for each in self._pending
        ]
        for waits in self._undetermined.values():
            decisions += [refusal(wait.offer, "wait", "undetermined", wait.reason) for wait in waits]
        self._pending, self._undetermined = [], defaultdict(list)
        return decisions


class _Tally:
    """How many measurements of a source had the same stamp: in columns, since it grows with their number; of the newest stamps.

    One that is older than all that is remembered gets a number that no other has.
    """

    def __init__(self) -> None:
        self._stamps, self._newest = array("q"), array("i")
        self._forgotten, self._strays = (
            -1,
            REMEMBERED,
        )  # the newest stamp that is; numbers given to older ones

    def count(self, stamp: int) -> int:
        """The number of another measurement with this stamp, from 0 on."""
        if stamp <= self._forgotten:
            self._strays += 1
            return self._strays
        at = self._place(stamp)
        self._newest[at] += 1
        return self._newest[at]

    def remember(self, stamp: int, n: int) -> None:
        at = self._place(stamp)
        self._newest[at] = max(self._newest[at], n)

    def _place(self, stamp: int) -> int:
        at = len(self._stamps)
        if at and stamp <= self._stamps[-1]:
            at = bisect_left(self._stamps, stamp)
            if self._stamps[at] == stamp:
                return at
        if len(self._stamps) >= REMEMBERED:
            half = len(self._stamps) // 2
            self._forgotten, at = self._stamps[half - 1], max(at - half, 0)
            del self._stamps[:half], self._newest[:half]
        self._stamps.insert(at, stamp)
        self._newest.insert(at, -1)
        return at


def _older_halves(offers: Sequence[Offer]) -> tuple[set[str], list[Decision]]:
    """Of each source that has more than its share of these: the ids of its older half, and one decision for all of it."""
    gone: set[str] = set()
    decisions = []
    for source, count in Counter(offer.measurement.source for offer in offers).items():
        if count > MOST_WAITING // 2:
            older = list(islice((o for o in offers if o.measurement.source == source), count // 2))
            gone |= {offer.id for offer in older}
            first = older[0].measurement
            decisions.append(decided(first, "refused", "wait/flood", float(count), count=len(older)))
    return gone, decisions


def refusal(offer: Offer, stage: str, reason: str, detail: str) -> Decision:
    m = offer.measurement
    return Decision(m.stamp, offer.id, m.source, "refused", stage, reason, detail, ends=m.ends)
