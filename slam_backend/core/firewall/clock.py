"""The clock of the driving source: its stamps move the watermark, so one wrong stamp must not carry it away."""

from ..graph import Decision
from ..measurement import SECOND, Measurement
from .rules import EPOCH, JUMP, SILENCE, USUAL, decided

Outcome = tuple[Measurement | Decision, ...]


class Clock:
    """Judges stamps in order of arrival. One that leaps ahead waits for the next message: if that follows it, the source was
    silent or its clock was set; if that is where the source was before, the leap is refused. So is, at the very start,
    a stamp that the next message lies far behind.
    """

    def __init__(self, lag: int) -> None:
        """lag: ns that messages may be out of order."""
        self._slack = max(lag, round(JUMP * SECOND))
        self.newest: int | None = None  # stamp of the newest message believed
        self._step: int | None = None  # ns between the newest two
        self._doubt: Measurement | None = None
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
        if self._doubt is None:
            if leap <= self._reach():
                return (self._believe(item),)
            self._doubt = item
            return ()
        return self._resolve(item, self._doubt, leap)

    def end(self) -> Outcome:
        """The input has ended: a leap that nothing contradicts is believed while there is no usual step to judge it by."""
        doubt, self._doubt = self._doubt, None
        if doubt is None:
            return ()
        if self.newest is None or self._step is None:
            return (self._believe(doubt),)
        return (self._refuse(doubt),)

    def _begin(self, item: Measurement) -> Outcome:
        doubt, self._doubt = self._doubt, item
        if doubt is None:
            return ()
        if item.stamp < doubt.stamp - self._slack:
            return (decided(doubt, "refused", "settle/jump", (doubt.stamp - item.stamp) / SECOND),)
        self._doubt = None
        return (self._believe(doubt), *self.judge(item))

    def _resolve(self, item: Measurement, doubt: Measurement, leap: int) -> Outcome:
        """The message after a leap."""
        assert self.newest is not None
        after = item.stamp - doubt.stamp
        reach = self._reach() if self._step is not None else USUAL * (doubt.stamp - self.newest)
        if 0 <= after <= max(reach, self._slack):
            self._doubt = None
            told = self._told(doubt)
            return (*told, self._believe(doubt), self._believe(item))
        refused = self._refuse(doubt)
        self._doubt = None
        if leap <= self._reach():
            return refused, self._believe(item)
        self._doubt = item
        return (refused,)

    def _went_back(self, item: Measurement, leap: int) -> Outcome:
        """Settling will refuse it; the second such message in a row tells that the clock was set, once."""
        before, self._behind = self._behind, item.stamp
        if self._set_back or before is None or not 0 < item.stamp - before <= self._slack:
            return (item,)
        self._set_back = True
        return (decided(item, "refused", "settle/clock_jump", leap / SECOND, -self._slack / SECOND),)

    def _told(self, doubt: Measurement) -> Outcome:
        """About a leap that was confirmed."""
        assert self.newest is not None
        seconds = (doubt.stamp - self.newest) / SECOND
        if seconds > EPOCH:
            return (decided(doubt, "accepted", "settle/clock_jump", seconds),)
        return (decided(doubt, "accepted", "settle/gap", seconds),) if seconds > SILENCE else ()

    def _refuse(self, doubt: Measurement) -> Decision:
        assert self.newest is not None
        return decided(doubt, "refused", "settle/jump", (doubt.stamp - self.newest) / SECOND)

    def _reach(self) -> float:
        """How far ahead the next stamp may be, in ns."""
        return max(self._slack, USUAL * (self._step or 0))

    def _believe(self, item: Measurement) -> Measurement:
        if self.newest is not None and item.stamp > self.newest:
            self._step = item.stamp - self.newest
        self.newest = item.stamp if self.newest is None else max(self.newest, item.stamp)
        return item
