"""The clock of the driving source: its stamps move the watermark, so one wrong stamp must not carry it away."""

from ..graph import Decision
from ..measurement import SECOND, Measurement
from .rules import EPOCH, JUMP, SILENCE, USUAL, WITNESSES, decided

Outcome = tuple[Measurement | Decision, ...]


class Clock:
    """Judges stamps in order of arrival. Those that leap ahead wait for WITNESSES in a row: then the source was silent or its
    clock was set. If a message comes from where the source was before, the leap is refused. So is, at the very start, a
    stamp that the next message lies far behind.
    """

    def __init__(self, lag: int) -> None:
        """lag: ns that messages may be out of order."""
        self._slack = max(lag, round(JUMP * SECOND))
        self.newest: int | None = None  # stamp of the newest message believed
        self._step: int | None = None  # ns between the newest two
        self._doubts: list[Measurement] = []  # each follows the one before
        self._behind: int | None = None  # the stamp of one that went back
        self._set_back = False  # the jump back has been told

    def judge(self, item: Measurement) -> Outcome:
        """What is believed now, and what was decided."""
        if self.newest is None:
            return self._begin(item)
        leap = item.stamp - self.newest
        if leap < -self._slack:
            return self._went_back(item, leap)
        self._behind, self._set_back = None, False
        if not self._doubts and leap <= self._reach():
            return (self._believe(item),)
        return self._doubted(item, leap)

    def end(self) -> Outcome:
        """The input has ended: a leap that nothing contradicts is believed if there is a witness, or no usual step to judge by."""
        if self.newest is None or self._step is None or len(self._doubts) > 1:
            return self._believe_doubts()
        return self._refuse_doubts()

    def _begin(self, item: Measurement) -> Outcome:
        if not self._doubts:
            self._doubts = [item]
            return ()
        (first,) = self._doubts
        if item.stamp < first.stamp - self._slack:
            self._doubts = [item]
            return (decided(first, "refused", "settle/jump", (first.stamp - item.stamp) / SECOND),)
        return (*self._believe_doubts(), *self.judge(item))

    def _doubted(self, item: Measurement, leap: int) -> Outcome:
        """A leap, or what comes after one."""
        if self._doubts and self._is_witness(item):
            self._doubts.append(item)
            return self._believe_doubts() if len(self._doubts) >= WITNESSES else ()
        refused = self._refuse_doubts()
        if leap <= self._reach():
            return (*refused, self._believe(item))
        self._doubts = [item]
        return refused

    def _is_witness(self, item: Measurement) -> bool:
        assert self.newest is not None
        reach = self._reach() if self._step is not None else USUAL * (self._doubts[0].stamp - self.newest)
        return 0 < item.stamp - self._doubts[-1].stamp <= max(reach, self._slack)

    def _went_back(self, item: Measurement, leap: int) -> Outcome:
        """Settling will refuse it; the second such message in a row tells that the clock was set, once."""
        before, self._behind = self._behind, item.stamp
        if self._set_back or before is None or not 0 < item.stamp - before <= self._slack:
            return (item,)
        self._set_back = True
        return (decided(item, "refused", "settle/clock_jump", leap / SECOND, -self._slack / SECOND),)

    def _believe_doubts(self) -> Outcome:
        doubts, self._doubts = self._doubts, []
        told: Outcome = ()
        if doubts and self.newest is not None:
            seconds = (doubts[0].stamp - self.newest) / SECOND
            if seconds > SILENCE:
                rule = "settle/clock_jump" if seconds > EPOCH else "settle/gap"
                told = (decided(doubts[0], "accepted", rule, seconds),)
        return (*told, *map(self._believe, doubts))

    def _refuse_doubts(self) -> Outcome:
        doubts, self._doubts = self._doubts, []
        newest = self.newest or 0
        return tuple(decided(d, "refused", "settle/jump", (d.stamp - newest) / SECOND) for d in doubts)

    def _reach(self) -> float:
        """How far ahead the next stamp may be, in ns."""
        return max(self._slack, USUAL * (self._step or 0))

    def _believe(self, item: Measurement) -> Measurement:
        if self.newest is not None and item.stamp > self.newest:
            self._step = item.stamp - self.newest
        self.newest = item.stamp if self.newest is None else max(self.newest, item.stamp)
        return item
