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
class Start:
    """A start that has every variable; initialize.py makes some.

    cost: of the initialization, where it has been computed. steps: what has been done from there already; settled: and
    that was enough. found: the layout of the factors, where it is known.
    """

    values: gtsam.Values
    name: str = "given"
    why: str = ""
    cost: float | None = None
    steps: tuple[Step, ...] = ()
    settled: str = ""
    found: Layout | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """values: every variable of the start. found: the graph's parts; gauged: the poses that hold those that floated.

    cost_initial: of the start, before its own steps. iterations: all that were done, in order. stop: why they ended.
    notes: what else people should know.
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
    start: gtsam.Values | Start,
    options: Options | None = None,
    progress: Progress = unwatched,
) -> Solution:
    """The optimum near a start. Parts that float get a gauge each; variables without factors stay where they are.

    progress: called after every iteration. SolverFailure if there is no edge, or the start's cost is not finite.
    """
    begun = start if isinstance(start, Start) else Start(start)
    return _solve(list(factors), begun, options or Options(), progress, near=False)


def polish(
    factors: Iterable[Factor],
    values: gtsam.Values,
    options: Options | None = None,
    progress: Progress = unwatched,
) -> Solution:
    """From an estimate that is near, as iSAM2's: Gauss-Newton until the largest step is below `options.step`."""
    return _solve(list(factors), Start(values), options or Options(), progress, near=True)


def _solve(factors: list[Factor], start: Start, options: Options, progress: Progress, near: bool) -> Solution:
    found = start.found or layout(factors, start.values)
    touched = found.touched(start.values)
    held = gauges(factors, found, touched, space_of(factors))
    descent = Descent([*factors, *held], touched, options, progress)
    before = descent.cost
    stop = start.settled or ("" if near else descent.run())
    if near or options.polish:
        stop = descent.polish()
    values = gtsam.Values(start.values)
    values.update(descent.values)
    return Solution(
        values, before if start.cost is None else start.cost, descent.cost, (*start.steps, *descent.steps), stop,
        found, tuple(factor.keys[0] for factor in held), tuple(descent.notes),
    )  # fmt: skip
