"""Loops that all enter, with a robust noise model; which of them count is read off the estimate.

A loop whose weight falls below a half is told to be on probation, with the weight: it is still in the graph, pulls less
than it says, and is restored when the estimate comes back to it. A kernel sees no further than the estimate's own
neighbourhood: from a drifted start true loops lie outside of it as well as wrong ones.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import sqrt
from typing import Any

import gtsam
import numpy as np

from ..graph import Decision, Delta, Estimate, Factor, Verdict
from ..measurement import Array
from .kernels import without_kernel
from .paths import Paths
from .stage import Judged

HALF = 0.5  # weight below which a loop no longer counts
LOOKS = 32  # loops looked at in one review, in turn, so that its cost does not grow with the graph


@dataclass(slots=True)
class Loop:
    """root: square root of its information (d, d). counts: what was told last."""

    factor: Factor
    root: Array
    counts: bool = True


class Soft:
    kinds = frozenset({"loop"})

    def __init__(self, stage: str, paths: Paths, kernel: Any, weight: Callable[[float], float]) -> None:
        """kernel: one of gtsam's m-estimators. weight: of a loop, 0 to 1, by its squared Mahalanobis distance."""
        self._stage, self._paths, self._kernel, self._weight = stage, paths, kernel, weight
        self._half = _halved(weight)
        self._loops: dict[str, Loop] = {}
        self._turn: list[str] = []  # to be looked at, the next one last

    def admit(self, proposed: Delta, estimate: Estimate) -> Judged:
        add, decisions = [], []
        for factor in proposed.add:
            noise = without_kernel(factor.factor.noiseModel())
            robust = gtsam.noiseModel.Robust.Create(self._kernel, noise)
            made = self._paths.space.between(*factor.keys, factor.factor.measured(), robust)
            loop = Loop(replace(factor, factor=made), np.asarray(noise.R()))
            self._loops[factor.id] = loop
            add.append(loop.factor)
            decisions.append(self._told(loop, "accepted", "weighed", self._distance(loop, estimate)))
        return Delta(tuple(add), proposed.remove, proposed.values), tuple(decisions)

    def review(self, estimate: Estimate) -> Judged:
        """Some in turn; all of them when the input has ended."""
        held = self._paths.factors
        if not self._turn or self._paths.ended:
            self._turn = list(reversed(self._loops))
        now = self._turn if self._paths.ended else self._turn[-LOOKS:]
        self._turn = self._turn[: len(self._turn) - len(now)]
        looked = [self._loops[id_] for id_ in reversed(now) if id_ in held]
        return Delta(), tuple(decision for loop in looked for decision in self._turned(loop, estimate))

    def _turned(self, loop: Loop, estimate: Estimate) -> list[Decision]:
        """What there is to tell of one whose weight has crossed the half."""
        distance = self._distance(loop, estimate)
        counts = self._weight(distance) >= HALF
        if counts == loop.counts:
            return []
        loop.counts = counts
        if counts:
            return [self._told(loop, "restored", "weighs_again", distance)]
        return [self._told(loop, "probation", "weighs_little", distance)]

    def _distance(self, loop: Loop, estimate: Estimate) -> float:
        """Squared, in standard deviations."""
        a, b = (estimate.pose(key) for key in loop.factor.keys)
        away = loop.factor.factor.measured().between(a.between(b))
        whitened = loop.root @ self._paths.space.logmap(away)
        return float(whitened @ whitened)

    def _told(self, loop: Loop, verdict: Verdict, reason: str, distance: float) -> Decision:
        """With what would let it count, where it does not."""
        factor, weight = loop.factor, self._weight(distance)
        words = f"its weight at the estimate is {weight:.3g}"
        basis: dict[str, Any] = {"distance": distance}
        if weight < HALF:
            larger = sqrt(distance / self._half)
            words += f"; would count if its own noise were {larger:.3g} times larger"
            basis["would_pass"] = {"loop": larger}
        return Decision(
            factor.stamp, factor.id, factor.source, verdict, self._stage, reason, words, weight, HALF, factor.stamps, basis=basis,
        )  # fmt: skip


def _halved(weight: Callable[[float], float]) -> float:
    """The largest distance at which a weight is a half at least."""
    low, high = 0.0, 1.0
    while weight(high) >= HALF:
        low, high = high, 2 * high
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if weight(middle) >= HALF else (low, middle)
    return low
