"""What a run believed at an earlier moment: its inputs are replayed until there.

`map@<t>` is what was believed when the watermark first passed the data stamp t: all up to t had been applied, and nothing
beyond. The result of a run is a function of its records in order of arrival, so this is what a replay of the input believes
that is cut there: to the bit with the same wheels. What came later (a loop, the polish at the end, a final batch) is not in it.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ..core.backend import Update
from ..core.decisions import as_json
from ..core.difference import Difference, Jumps, difference
from ..core.errors import SolverFailure
from ..core.graph import Decision, keyframe
from ..core.measurement import Array, format_stamp
from ..core.query import Unknown
from ..core.shown import Shown
from .replay import Run


class Past:
    """Asked in order of stamp, one replay serves all; asked for something earlier, it begins anew."""

    def __init__(self, begin: Callable[[], Run]) -> None:
        """begin: a new replay of the same input."""
        self._begin = begin
        self._run: Run | None = None
        self._at = 0  # the stamp at which the run stands

    def run_at(self, stamp: int, told: Callable[[Update], object] = lambda _: None) -> Run:
        """The run, standing there; Unknown where it never was, or had no keyframe yet. told: each update on the way."""
        if self._run is None or stamp < self._at:
            self._run = self._begin()
        run, self._at = self._run, stamp
        if not run.reach(stamp, told):
            self._at = run.reached
            raise Unknown(
                f"nothing was applied at {format_stamp(stamp)}: the input ends at {format_stamp(run.reached)}"
            )
        if not len(run.backend.timeline):
            raise Unknown(f"there was no keyframe yet at {format_stamp(stamp)}")
        return run

    def at(self, stamp: int) -> "Then":
        """Unknown where the run never was."""
        return Then(self, stamp)

    def between(self, first: int, last: int) -> Difference:
        """What changed from one stamp to a later one. Unknown where the run never was at one of them."""
        run, jumps = self.run_at(first), Jumps()
        before, factors = run.backend.snapshot(), dict(run.backend.solver.factors)
        if run.last is not None:
            jumps.add(run.last)
        run = self.run_at(last, jumps.add)
        return difference(before, run.backend.snapshot(), factors, run.backend.solver.factors, jumps)


class Then(Shown):
    """What was believed at a stamp. Implements core.query.Known."""

    def __init__(self, past: Past, stamp: int) -> None:
        """Unknown where the run never was."""
        run = past.run_at(stamp)
        super().__init__(run.backend.snapshot(), run.config)
        self._past, self._stamp = past, stamp

    def covariance(self, index: int) -> Array:
        run = self._past.run_at(self._stamp)
        if index >= len(run.backend.timeline):
            raise SolverFailure(f"there is no keyframe k{index}", ())
        return np.asarray(run.backend.estimate.covariance([keyframe(index, 0).pose]))

    def decision(self, identifier: str) -> Mapping[str, Any] | None:
        """The last one about it that had been made."""
        decided = list(self._past.run_at(self._stamp).decisions)
        found: Decision | None = next((each for each in reversed(decided) if each.id == identifier), None)
        return None if found is None else as_json(found)

    def past(self, stamp: int) -> "Then":
        return self._past.at(stamp)
