"""What a person asks of the graph, done between two measurements; ACTIONS is the list of it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gtsam

from .apply import Applier
from .command import Command
from .errors import SlamError
from .graph import is_pose
from .solvers import Solver
from .solvers.batch import polish
from .space import Space

NOTICEABLE = (1e-3, 1e-4)  # m, rad: a correction of a pose that counts as a revision


@dataclass(frozen=True, slots=True)
class Shift:
    """The largest change of any pose: m, rad."""

    meters: float
    radians: float

    @property
    def noticeable(self) -> bool:
        return self.meters > NOTICEABLE[0] or self.radians > NOTICEABLE[1]


@dataclass(frozen=True, slots=True)
class Outcome:
    """told: plain data for whoever asked. revised: poses that are published have changed."""

    told: Mapping[str, Any]
    revised: bool


class Editor:
    """Acts on the graph as a whole. What it cannot do is a SlamError, and has changed nothing."""

    def __init__(self, solver: Solver, space: Space, applier: Applier) -> None:
        self._solver, self._space, self._applier = solver, space, applier

    def carry_out(self, command: Command) -> Outcome:
        action = ACTIONS.get(command.action)
        if action is None:
            raise SlamError(f"there is no action '{command.action}'; known: {', '.join(ACTIONS)}")
        if self._applier.estimate is None:
            raise SlamError("there is no keyframe yet")
        return action(self, command.arguments)

    def optimize(self, arguments: Mapping[str, Any]) -> Outcome:  # noqa: ARG002  # one signature for the table
        """The optimum of the kept factors; the solver goes on from there, linearized anew."""
        assert self._applier.estimate is not None
        factors = list(self._solver.factors.values())
        before = self._applier.estimate.values()
        found = polish(factors, before)
        self._applier.estimate = self._solver.restart(factors, found.values)
        shift = self._shift(before, self._applier.estimate.values())
        told = {
            "cost": {"before": found.cost_initial, "after": found.cost},
            "iterations": len(found.iterations),
            "stop": found.stop,
            "largest_shift": {"m": shift.meters, "rad": shift.radians},
        }
        return Outcome(told, shift.noticeable)

    def _shift(self, before: gtsam.Values, after: gtsam.Values) -> Shift:
        keys = [key for key in before.keys() if is_pose(key) and after.exists(key)]  # noqa: SIM118  # no mapping
        pose_in, size = self._space.pose_in, self._space.size
        sizes = [size(pose_in(before, key).between(pose_in(after, key))) for key in keys]
        return Shift(max((m for m, _ in sizes), default=0.0), max((r for _, r in sizes), default=0.0))


ACTIONS: Mapping[str, Callable[[Editor, Mapping[str, Any]], Outcome]] = {
    "optimize": Editor.optimize,
}
