"""gtsam's batch optimizers, stepped one iteration at a time, so that every stop has its reason.

Elimination is by Cholesky until that fails or ends in strong damping, then by QR: on anisotropic information (a ratio of
2e11 in public data) Cholesky ends in a wrong place without a word, where QR takes as few iterations as on any other
graph. Diagonal damping, the usual remedy, takes five times as many.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any, Literal, NamedTuple

import gtsam
import numpy as np

from ..errors import SolverFailure
from ..graph import HOLDING, Factor
from .planar import Planar

MethodName = Literal["lm", "gn", "dogleg"]

NO_FALL, SMALL_STEP, LIMIT = "cost no longer falls", "step below tolerance", "iteration limit"
SETTLED = "cost settled: each fall a small part of the last"
ROUNDING = "step at the rounding of the numbers"
BOUND, SINGULAR, RISES = "lambda at its bound", "singular system", "cost rises"

DAMPED = 1e-4  # lambda above which a short step may have been the damping's wish
FAST = 0.1  # of the last fall of the cost: Newton's convergence, where the falls that follow sum to less than 1.2 of the next
REST = 10.0  # times `relative`: what may be left to fall then
UNDAMPED = 1e-8  # lambda that is nothing beside any information, and with which Levenberg-Marquardt begins
ZERO = 1e-8  # a cost below which every edge is met
PATIENCE = 5  # iterations without a better cost after which Gauss-Newton is given up
SHRINKS = 0.7  # of the last step: near the optimum, steps that shrink less than that are only rounding


class Step(NamedTuple):
    """One iteration. cost: after it, gauges left out; step: largest change (m, rad); damping: lambda or trust radius."""

    cost: float
    step: float
    damping: float


Progress = Callable[[Step], None]


def unwatched(_: Step) -> None:
    """Nobody looks."""


@dataclass(frozen=True, slots=True)
class Options:
    """relative: decrease of the cost, as a part of it, that counts as none.

    polish: go on from there by Gauss-Newton until the largest step (m, rad) is below `step`.
    """

    method: MethodName = "lm"
    ordering: Literal["colamd", "metis"] = "colamd"
    iterations: int = 100
    relative: float = 1e-5
    step: float = 1e-9
    polish: bool = False


class Method(NamedTuple):
    name: str
    params: Callable[[], Any]
    optimizer: Callable[..., Any]
    damping: Callable[[Any], float]


METHODS: Mapping[MethodName, Method] = {
    "lm": Method(
        "Levenberg-Marquardt",
        gtsam.LevenbergMarquardtParams,
        gtsam.LevenbergMarquardtOptimizer,
        lambda optimizer: float(optimizer.lambda_()),
    ),
    "gn": Method("Gauss-Newton", gtsam.GaussNewtonParams, gtsam.GaussNewtonOptimizer, lambda _: 0.0),
    "dogleg": Method(
        "Dogleg",
        gtsam.DoglegParams,
        gtsam.DoglegOptimizer,
        lambda optimizer: float(optimizer.getDelta()),
    ),
}


Advance = Callable[[], tuple[gtsam.Values, float, float]]  # one iteration: values, cost with gauges, damping


class Descent:
    """One graph on its way down. `values` and `cost` are the best so far, `steps` all that was done."""

    def __init__(
        self, factors: Iterable[Factor], start: gtsam.Values, options: Options, progress: Progress = unwatched
    ) -> None:
        """start: every variable that the factors touch, and no other. SolverFailure if its cost is not finite."""
        self._factors = list(factors)
        self._graph, self._gauges = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
        for factor in self._factors:
            self._graph.add(factor.factor)
            if factor.kind in HOLDING:
                self._gauges.add(factor.factor)
        self._options, self._progress = options, progress
        self.values = start
        self._error = float(self._graph.error(start))  # with gauges: what is minimized
        self.cost = self._error - self._gauges.error(start)
        if not isfinite(self._error):
            raise SolverFailure("the cost of the start is not finite", ())
        self.steps: list[Step] = []
        self.notes: list[str] = []
        self._qr = False

    def run(self) -> str:
        """Descend by the method of the options; why it ended."""
        stop = self._descend(self._options.method)
        if self._qr or not self._doubtful(stop):
            return stop
        before, self._qr = self.cost, True
        stop = self._descend(self._options.method)
        if before - self.cost > self._options.relative * before:
            self.notes.append("eliminated by QR: Cholesky lost its way in the scales of the information")
        return stop

    def polish(self) -> str:
        """Gauss-Newton until the step is below `options.step`; where it leads away, Levenberg-Marquardt goes first."""
        stop = self._settle()
        if stop in (SINGULAR, RISES):
            self._qr = self._qr or stop == SINGULAR
            self._descend("lm")
            stop = self._settle()
        return stop

    def _doubtful(self, stop: str) -> bool:
        damped = self._options.method == "lm" and bool(self.steps) and self.steps[-1].damping > DAMPED
        return stop in (BOUND, SINGULAR, RISES) or (stop == NO_FALL and damped and self._error >= ZERO)

    def _descend(self, method: MethodName) -> str:
        """Until the cost no longer falls. Gauss-Newton may climb on its way."""
        advance, at, before, worse, fell = self._native(method), self.values, self._error, 0, 0.0
        bound = gtsam.LevenbergMarquardtParams().getlambdaUpperBound()
        while self._error >= ZERO and len(self.steps) < self._options.iterations:
            if (found := self._iterate(advance, at)) is None:
                return SINGULAR
            at, error = found
            worse = 0 if error <= self._error else worse + 1
            if worse >= PATIENCE or not isfinite(error):
                return RISES
            if error >= before and method == "lm" and self.steps[-1].damping >= bound:
                return BOUND
            last, fell = fell, before - error
            if abs(fell) <= self._options.relative * before:
                return NO_FALL
            if self._at_end(last, fell, error):
                return SETTLED
            before = error
        return LIMIT if self._error >= ZERO else NO_FALL

    def _at_end(self, last: float, fell: float, error: float) -> bool:
        """Whether the cost falls so much faster each time that what is left, by the last two, need not be waited for."""
        quick = 0 < fell < FAST * last and self.steps[-1].damping <= UNDAMPED
        return quick and fell * fell / last <= REST * self._options.relative * error

    def _settle(self) -> str:
        """Gauss-Newton by the length of its steps. A cost that rises beyond rounding ends it."""
        planar = any(isinstance(factor.factor, gtsam.PriorFactorPose2) for factor in self._factors)
        advance = self._exact() if planar else self._native("gn")
        at, last, stale = self.values, inf, 0
        while len(self.steps) < self._options.iterations:
            before = self._error
            if (found := self._iterate(advance, at)) is None:
                return SINGULAR
            at, error = found
            length = self.steps[-1].step
            if not isfinite(error) or error - before > self._options.relative * (before + 1):
                return RISES
            if length < self._options.step:
                self._take(at, error)  # the better by its step, be the cost a rounding higher
                return SMALL_STEP
            stale = stale + 1 if length > SHRINKS * last and length < self._options.relative else 0
            if stale == PATIENCE:
                return ROUNDING
            last = length
        return LIMIT

    def _iterate(self, advance: Advance, at: gtsam.Values) -> tuple[gtsam.Values, float] | None:
        """The values and the cost with gauges after one iteration, None if the system could not be solved."""
        try:
            values, error, damping = advance()
        except (RuntimeError, IndexError):  # an indeterminate system; a lost key on the way to it
            return None
        cost = error - float(self._gauges.error(values))
        length = float(np.abs(at.localCoordinates(values).vector()).max(initial=0.0))
        self.steps.append(Step(cost, length, damping))
        self._progress(self.steps[-1])
        if error < self._error:
            self._take(values, error)
        return values, error

    def _take(self, values: gtsam.Values, error: float) -> None:
        self.values, self._error = values, error
        self.cost = error - float(self._gauges.error(values))

    def _native(self, method: MethodName) -> Advance:
        row = METHODS[method]
        params = row.params()
        params.setOrderingType(self._options.ordering.upper())
        params.setLinearSolverType("MULTIFRONTAL_QR" if self._qr else "MULTIFRONTAL_CHOLESKY")
        if method == "lm":
            params.setlambdaInitial(UNDAMPED)  # gtsam's 1e-5 is a brake where the information is as small
        optimizer = row.optimizer(self._graph, self.values, params)

        def advance() -> tuple[gtsam.Values, float, float]:
            optimizer.iterate()
            values = gtsam.Values(optimizer.values())  # a copy: the optimizer overwrites its own
            return values, float(optimizer.error()), row.damping(optimizer)

        return advance

    def _exact(self) -> Advance:
        planar, values = Planar(self._factors), self.values

        def advance() -> tuple[gtsam.Values, float, float]:
            nonlocal values
            values = planar.step(values)
            return values, float(self._graph.error(values)), 0.0

        return advance
