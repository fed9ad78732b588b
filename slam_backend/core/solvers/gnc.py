"""Graduated non-convexity (Yang et al., RA-L 2020) with truncated least squares: which loops are wrong, decided offline.

Only factors of kind `loop` are judged. It starts from an estimate, so the better the start, the better the verdict. The
schedule is the linear one. Each weighting is followed by a few iterations of Levenberg-Marquardt, not by a whole descent:
on public graphs the verdicts are as good, at a third of the time, and work can be spread and broken off.

gtsam's own GncLMOptimizer takes weights near 0 for settled. Where a loop begins with a cost of 1e5, as on a drifted
drive, every weight begins near 0: it ends at once and refuses all. Here only a loop that the truncated loss leaves
between its two bounds is unsettled, and the schedule must have left its convex beginning.
"""

from collections.abc import Iterable
from typing import NamedTuple

import gtsam
import numpy as np

from ..graph import Factor
from ..measurement import Array
from ..robust.chi2 import chi2_quantile
from ..robust.kernels import without_kernel
from .batch import Solution, Start, solve
from .descent import Descent, Options, Progress, unwatched
from .gauges import gauges, layout, space_of

KEPT = 0.5  # weight, between 0 and 1, from which a loop stays
INLIERS = 0.99  # of the true loops, those whose cost the truncation lets grow undiminished
GROWTH = 1.4  # of mu with each weighting
INNER = 2  # iterations between two weightings
CONVEX = 0.01  # mu below which the loss is still nearly convex, and weights near 0 say nothing
NEGLIGIBLE = 1e-8  # weight below which a factor is left out
ROUNDS = 300  # from residuals of 1e10 with GROWTH, and as many again


class Judged(NamedTuple):
    """solution: the optimum of what was kept. refused: ids of the loops that were not."""

    solution: Solution
    refused: tuple[str, ...]


def solve_gnc(
    factors: Iterable[Factor],
    start: gtsam.Values | Start,
    options: Options | None = None,
    progress: Progress = unwatched,
) -> Judged:
    """Judge the loops, then solve without those that are refused. progress: called after every iteration of both."""
    factors, options = list(factors), options or Options()
    values = start.values if isinstance(start, Start) else start
    graduation = Graduation(factors, values, options, progress)
    while not graduation.advance():
        pass
    refused = graduation.refused
    kept = [factor for factor in factors if factor.id not in refused]
    solution = solve(kept, values, options, progress)
    return Judged(solution, tuple(factor.id for factor in factors if factor.id in refused))


class Graduation:
    """One judgment, a weighting at a time. weights: (L,) of the loops, in order; values: the estimate with them."""

    def __init__(
        self,
        factors: Iterable[Factor],
        start: gtsam.Values,
        options: Options | None = None,
        progress: Progress = unwatched,
    ) -> None:
        factors = list(factors)
        found = layout(factors, start)
        self._space = space_of(factors)
        self._sure = [factor for factor in factors if factor.kind != "loop"]
        self._sure += gauges(factors, found, start, self._space)
        self.loops = [factor for factor in factors if factor.kind == "loop"]
        self._roots = [np.asarray(without_kernel(f.factor.noiseModel()).R()) for f in self.loops]
        options = options or Options()
        self._options = Options(ordering=options.ordering, iterations=INNER)
        self._progress = progress
        self._limit = chi2_quantile(INLIERS, self._space.dimension) / 2  # as gtsam counts: costs are chi2/2
        self.weights = np.ones(len(self.loops))
        self.values = found.touched(start)
        self._mu = 0.0  # not yet begun
        self._rounds = 0

    @property
    def refused(self) -> frozenset[str]:
        """One that contradicts nothing else cannot be told to be wrong."""
        pairs = zip(self.loops, self.weights, strict=True)
        return frozenset(factor.id for factor, weight in pairs if weight < KEPT)

    def advance(self) -> bool:
        """Descend a little, weigh anew; whether that has settled."""
        self._descend()
        costs = self.costs()
        if not self._mu:
            worst = float(costs.max(initial=0.0))
            if 2 * worst <= self._limit:
                return True  # nothing contradicts anything
            self._mu = self._limit / (2 * worst - self._limit)
        low, high = self._limit * self._mu / (self._mu + 1), self._limit * (self._mu + 1) / self._mu
        between = np.sqrt(self._limit * self._mu * (self._mu + 1) / np.maximum(costs, low)) - self._mu
        self.weights = np.where(costs >= high, 0.0, np.where(costs <= low, 1.0, between))
        settled = self._mu > CONVEX and not ((costs > low) & (costs < high)).any()
        self._mu *= GROWTH
        self._rounds += 1
        return settled or self._rounds >= ROUNDS

    def costs(self) -> Array:
        """(L,) chi2/2 of each loop at the estimate, unweighted."""
        errors = zip(self.loops, self._roots, strict=True)
        return np.array(
            [np.sum((root @ f.factor.unwhitenedError(self.values)) ** 2) / 2 for f, root in errors]
        )

    def _descend(self) -> None:
        pairs = zip(self.loops, self._roots, self.weights, strict=True)
        weighed = [
            self._weighed(factor, root, weight) for factor, root, weight in pairs if weight > NEGLIGIBLE
        ]
        descent = Descent([*self._sure, *weighed], self.values, self._options, self._progress)
        descent.run()
        self.values = descent.values

    def _weighed(self, factor: Factor, root: Array, weight: float) -> Factor:
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(np.sqrt(weight) * root)
        made = self._space.between(*factor.keys, factor.factor.measured(), noise)
        return Factor(factor.id, factor.kind, made, factor.keys, factor.stamp, factor.stamps)
