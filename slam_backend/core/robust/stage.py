"""What a robust stage is."""

from typing import Protocol

from ..graph import Decision, Delta, Estimate

Judged = tuple[Delta, tuple[Decision, ...]]


class Robust(Protocol):
    @property
    def kinds(self) -> frozenset[str]:
        """Of the factors it judges; all others enter unjudged."""
        ...

    def admit(self, proposed: Delta, estimate: Estimate) -> Judged:
        """What of the proposed change may enter, and a decision for each factor."""
        ...

    def review(self, estimate: Estimate) -> Judged:
        """Second thoughts about what entered earlier or waits, once the estimate is new.

        What it removes is decided here; what it adds is decided once the other stages have judged it, and the solver taken it.
        """
        ...
