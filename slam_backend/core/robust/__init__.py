"""Robust stages: what judges proposed factors before they enter, and reviews them after.

A stage sees the factors that the solver has not taken yet, with an estimate that already knows the newest
keyframe (motion goes in first), so joint covariances with it exist. One file per strategy; ROBUST is the list of
them, KERNELS (in kernels.py) the list of robust kernels, which act per source.
"""

from collections.abc import Mapping
from typing import Any, Protocol

from ..graph import Decision, Delta, Estimate

Judged = tuple[Delta, tuple[Decision, ...]]


class Robust(Protocol):
    kinds: frozenset[str]  # of the factors it judges; all others enter unjudged

    def admit(self, proposed: Delta, estimate: Estimate) -> Judged:
        """What of the proposed change may enter, and a decision for each factor."""
        ...

    def review(self, estimate: Estimate) -> Judged:
        """Second thoughts about what entered earlier or waits, once the estimate is new."""
        ...


ROBUST: Mapping[str, type[Any]] = {}
