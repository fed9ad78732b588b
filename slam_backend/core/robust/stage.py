"""What a robust stage is."""

from typing import Any, Protocol

from ..graph import Decision, Delta, Estimate, Factor, Verdict

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


def judged(
    stage: str,
    loop: Factor,
    verdict: Verdict,
    reason: str,
    detail: str,
    statistic: float | None,
    threshold: float | None,
    **basis: Any,
) -> Decision:
    """A decision of a stage about a loop."""
    return Decision(
        loop.stamp, loop.id, loop.source, verdict, stage, reason, detail, statistic, threshold,
        loop.stamps, basis=basis,
    )  # fmt: skip
