"""Graduated non-convexity (Yang et al., RA-L 2020) with truncated least squares: which loops are wrong, decided offline.

gtsam's optimizer with its linear schedule; the super-linear one and Geman-McClure gave wrong answers on known data. Only
factors of kind `loop` are judged. It starts from an estimate, so the better the start, the better the verdict.
"""

from collections.abc import Iterable
from typing import NamedTuple

import gtsam

from ..graph import Factor
from .batch import Solution, Start, solve
from .descent import Options, Progress, unwatched
from .gauges import gauges, layout, space_of

KEPT = 0.5  # weight, between 0 and 1, from which a loop stays


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
    """Judge the loops, then solve without those that are refused. No progress while gtsam judges."""
    factors, options = list(factors), options or Options()
    values = start.values if isinstance(start, Start) else start
    refused = frozenset(_refused(factors, values, options))
    kept = [factor for factor in factors if factor.id not in refused]
    solution = solve(kept, values, options, progress)
    return Judged(solution, tuple(factor.id for factor in factors if factor.id in refused))


def _refused(factors: list[Factor], start: gtsam.Values, options: Options) -> Iterable[str]:
    """Ids of the loops whose weight has gone. One that contradicts nothing else cannot be told to be wrong."""
    found = layout(factors, start)
    held = gauges(factors, found, start, space_of(factors))
    graph = gtsam.NonlinearFactorGraph()
    for factor in (*factors, *held):
        graph.add(factor.factor)
    inner = gtsam.LevenbergMarquardtParams()
    inner.setOrderingType(options.ordering.upper())
    params = gtsam.GncLMParams(inner)
    params.setLossType(gtsam.GncLossType.TLS)
    params.setScheduler(gtsam.GncScheduler.Linear)
    params.setKnownInliers([n for n, factor in enumerate((*factors, *held)) if factor.kind != "loop"])
    judge = gtsam.GncLMOptimizer(graph, found.touched(start), params)
    judge.optimize()
    return [factor.id for factor, weight in zip(factors, judge.getWeights(), strict=False) if weight < KEPT]
