"""How far a session is restored, in lines for the terminal."""

from collections.abc import Callable
from time import monotonic

STEP = 0.1  # of the whole, between two lines


class Restoring:
    """total: records that are to be applied again; 0: none."""

    def __init__(self, total: int, say: Callable[[str], None]) -> None:
        self._total, self._say = total, say
        self._next = STEP
        self._begin = monotonic()
        self._over = not total

    def look(self, applied: int) -> None:
        """Say how far it is, if there is news. applied: records."""
        if self._over:
            return
        share = applied / self._total
        if share >= 1:
            self._over = True
            self._say(f"restored: {self._total} records in {monotonic() - self._begin:.1f} s; live goes on")
        elif share >= self._next:
            self._next = share + STEP
            self._say(f"restoring: {share:.0%} of {self._total} records")
