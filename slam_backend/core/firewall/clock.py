"""The clock of the driving source: its stamps move the watermark, so one wrong message must not carry it away."""

from ..graph import Decision
from ..measurement import SECOND, Measurement
from .continuity import UNBOUND, Pace
from .rules import EPOCH, JUMP, SILENCE, USUAL, WITNESSES, decided

Outcome = tuple[Measurement | Decision, ...]


class Clock:
    """Judges messages in order of arrival, before they move the watermark. Those whose stamps leap ahead wait for WITNESSES in a row:
    then the source was silent or its clock was set. If a message comes from where the source was before, the leap is refused. So is,
    at the very start, a stamp that the next message lies far behind. A message that breaks the pace waits for the next one.
    """

    def __init__(self, lag: int, pace: Pace = UNBOUND) -> None:
        """lag: ns that messages may be out of order."""
        self._slack, self._pace = max(lag, round(JUMP * SECOND)), pace
        self._last: Measurement | None = None  # the newest message believed
        self._step: int | None = None  # ns between the newest two
        self._doubts: list[Measurement] = []  # each follows the one before
        self._behind: int | None = None  # the stamp of one that went back
        self._set_back = False  # the jump back has been told

    @property
    def newest(self) -> int | None:
        """Stamp of the newest message believed."""
        return None if self._last is None else self._last.stamp

    def judge(self, item: Measurement) -> Outcome:
        """What is believed now, and what was decided."""
        last = self._last
        if last is None:
            return self._begin(item)
        leap = item.stamp - last.stamp
        if leap < -self._slack:
            return self._went_back(item, leap)
        self._behind, self._set_back = None, False
        # One that is older moves nothing: what it says is judged in its turn.
        doubt = self._doubts[-1] if self._doubts and not self._leaps(self._doubts[0]) else None
        if leap <= 0 or (leap <= self._reach() and self._pace.follows(last, doubt, item)):
            refused = self._refuse_doubts() if self._doubts else ()
            return (*refused, self._believe(item))
        return self._doubted(item)

    def end(self) -> Outcome:
        """The input has ended: a leap that nothing contradicts is believed if there is a witness, or no usual step to judge by."""
        if self._last is None or self._step is None or len(self._doubts) > 1:
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

    def _doubted(self, item: Measurement) -> Outcome:
        """A leap, or what comes after one."""
        if (
            self._doubts and item.stamp == self._doubts[-1].stamp
        ):  # no witness: it may be the same message again
            return (decided(item, "refused", "recheck/duplicate"),)
        if self._doubts and self._is_witness(item):
            self._doubts.append(item)
            enough = WITNESSES if self._leaps(self._doubts[0]) else 2
            return self._believe_doubts() if len(self._doubts) >= enough else ()
        refused = self._refuse_doubts()
        self._doubts = [item]
        return refused

    def _leaps(self, item: Measurement) -> bool:
        """In time."""
        assert self._last is not None
        return item.stamp - self._last.stamp > self._reach()

    def _is_witness(self, item: Measurement) -> bool:
        assert self._last is not None
        doubt = self._doubts[-1]
        reach = (
            self._reach() if self._step is not None else USUAL * (self._doubts[0].stamp - self._last.stamp)
        )
        follows = 0 < item.stamp - doubt.stamp <= max(reach, self._slack)
        return follows and self._pace.breach(doubt, item) is None

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
        if doubts and self._last is not None:
            seconds = (doubts[0].stamp - self._last.stamp) / SECOND
            if seconds > SILENCE:
                rule = "settle/clock_jump" if seconds > EPOCH else "settle/gap"
                told = (decided(doubts[0], "accepted", rule, seconds),)
        return (*told, *map(self._believe, doubts))

    def _refuse_doubts(self) -> Outcome:
        doubts, self._doubts = self._doubts, []
        return tuple(map(self._refusal, doubts))

    def _refusal(self, doubt: Measurement) -> Decision:
        last = self._last
        assert last is not None
        breach = None if self._leaps(doubt) else self._pace.breach(last, doubt)
        return decided(doubt, "refused", *(breach or ("settle/jump", (doubt.stamp - last.stamp) / SECOND)))

    def _reach(self) -> float:
        """How far ahead the next stamp may be, in ns."""
        return max(self._slack, USUAL * (self._step or 0))

    def _believe(self, item: Measurement) -> Measurement:
        if self._last is None:
            self._last = item
        elif item.stamp > self._last.stamp:
            self._step, self._last = item.stamp - self._last.stamp, item
        return item
