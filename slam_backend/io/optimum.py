"""From a pose graph file to its optimum: initialization, descent, robustness, in the order that `solve` takes them.

The clock is read here, after every iteration; the core has none.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Literal

from ..core.config import KernelName
from ..core.graph import Factor
from ..core.solvers.batch import Solution, Start, polish, solve
from ..core.solvers.descent import MethodName, Options, Step
from ..core.solvers.gnc import solve_gnc
from ..core.solvers.initialize import InitializationName, cost_of, initialize
from .online import solve_online
from .problem import Problem

Advance = Callable[[int], None]


@dataclass(frozen=True, slots=True)
class Request:
    """What `solve` is asked for; the kernel is in the problem already."""

    method: MethodName | Literal["isam2"] = "lm"
    gnc: bool = False
    kernel: KernelName = "none"  # for isam2, which makes its own factors
    init: InitializationName = "auto"
    ordering: Literal["colamd", "metis"] = "colamd"
    polish: bool = False

    @property
    def options(self) -> Options:
        method: MethodName = "lm" if self.method == "isam2" else self.method
        return Options(method, self.ordering, polish=self.polish)


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """start: with why it was chosen, and its cost. steps: each with the seconds it took; seconds: of all of them and of
    the initialization. refused: the loops that GNC took out; the costs of the solution are those of what it kept.
    cost_initial: of the file's vertices, or of the odometry where it states none. left_out: what the problem has and the method does
    not take, in words; it is in the costs.
    """

    start: Start
    cost_start: float
    cost_initial: float
    solution: Solution
    steps: tuple[tuple[Step, float], ...]
    seconds: float
    refused: tuple[Factor, ...] = ()
    left_out: tuple[str, ...] = ()


def optimum(problem: Problem, request: Request, advance: Advance) -> Optimum:
    """Solve. advance: called with 1 after every iteration; with isam2, of every vertex."""
    watch = Watch(advance)
    factors, options = problem.factors, request.options
    refused: tuple[str, ...] = ()
    left: tuple[str, ...] = ()
    if request.method == "isam2":
        online, relinearized = solve_online(problem, request.kernel, advance)
        start = Start(online, "isam2", "iSAM2's last estimate", cost_of(factors, online))
        nothing = replace(options, iterations=0, polish=False)
        solution = replace(solve(factors, relinearized, nothing), stop="every vertex is in")
        if request.polish:
            solution = polish(factors, relinearized, options, watch)
        else:
            left = tuple(
                f"{what} (isam2 goes vertex by vertex; --polish, or another --method, takes them)"
                for what in problem.graph.timeless
                if what not in problem.left_out
            )
    else:
        # wrong loops would lead any start astray that rests on them
        init = "odometry" if request.gnc and request.init == "auto" else request.init
        start = initialize(factors, problem.stated, init, options, watch)
        if request.gnc:
            solution, refused = solve_gnc(factors, start, options, watch)
        else:
            solution = solve(factors, start, options, watch)
    seconds, gone = watch.elapsed, set(refused)
    removed = tuple(factor for factor in factors if factor.id in gone)
    before = solution.cost_initial if start.cost is None else start.cost
    return Optimum(start, before, _untouched(problem), solution, tuple(watch.steps), seconds, removed, left)


def _untouched(problem: Problem) -> float:
    """Cost of the file's vertices, or of the odometry where the file states none."""
    before: InitializationName = "odometry" if problem.graph.states is None else "file"
    return cost_of(problem.factors, initialize(problem.factors, problem.stated, before).values)


class Watch:
    """Takes the time of each iteration."""

    def __init__(self, advance: Advance) -> None:
        self.steps: list[tuple[Step, float]] = []
        self._advance = advance
        self._begin = self._last = perf_counter()

    def __call__(self, step: Step) -> None:
        now = perf_counter()
        self.steps.append((step, now - self._last))
        self._last = now
        self._advance(1)

    @property
    def elapsed(self) -> float:
        return perf_counter() - self._begin
