"""The whole graph at once, from a start that has every variable (initialize.py has some) to the optimum.

Costs are chi2/2 of the factors; gauge priors are left out of every number.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import gtsam

from ..graph import Factor
from .descent import Descent, Options, Progress, Step, unwatched
from .gauges import Layout, gauges, layout, space_of


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """values: every variable of the start. found: the graph's parts; gauged: the poses that hold those that floated.

    iterations: all that were done, in order. stop: why they ended. notes: what else people should know.
    """

    values: gtsam.Values
    cost_initial: float
    cost: float
    iterations: tuple[Step, ...]
    stop: str
    found: Layout
    gauged: tuple[int, ...]
    notes: tuple[str, ...]


def solve(
    factors: Iterable[Factor],
    start: gtsam.Values,
    options: Options | None = None,
    progress: Progress = unwatched,
) -> Solution:
    """The optimum near a start. Parts that float get a gauge each; variables without factors stay where they are.

    progress: called after every iteration. SolverFailure if there is no edge, or the start's cost is not finite.
    """
    return _solve(list(factors), start, options or Options(), progress, near=False)


def polish(
    factors: Iterable[Factor],
    values: gtsam.Values,
    options: Options | None = None,
    progress: Progress = unwatched,
) -> Solution:
    """From an estimate that is near, as iSAM2's: Gauss-Newton until the largest step is below `options.step`."""
    return _solve(list(factors), values, options or Options(), progress, near=True)


def _solve(
    factors: list[Factor], start: gtsam.Values, options: Options, progress: Progress, near: bool
) -> Solution:
    found = layout(factors, start)
    touched = found.touched(start)
    held = gauges(factors, found, touched, space_of(factors))
    descent = Descent([*factors, *held], touched, options, progress)
    before = descent.cost
    stop = "" if near else descent.run()
    if near or options.polish:
        stop = descent.polish()
    values = gtsam.Values(start)
    values.update(descent.values)
    return Solution(
        values, before, descent.cost, tuple(descent.steps), stop, found,
        tuple(factor.keys[0] for factor in held), tuple(descent.notes),
    )  # fmt: skip
