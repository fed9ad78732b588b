"""Robust stages: what judges proposed factors before they enter, and reviews them after.

A stage sees the factors that the solver has not taken yet, with an estimate that already knows the newest
keyframe (motion goes in first), so joint covariances with it exist. What one stage lets in, at `admit` or at `review`, is
judged by the others of the list. One file per strategy; ROBUST is the list of them, KERNELS (in kernels.py) the list of
robust kernels, which act per source.
"""

from collections.abc import Callable, Mapping
from typing import Protocol

from ..config import Config, StageName
from ..graph import Decision, Delta, Estimate
from .paths import Paths

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


ROBUST: Mapping[StageName, Callable[[Config, Paths], Robust]] = {}
