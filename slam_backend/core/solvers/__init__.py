"""A solver takes changes to the graph and gives estimates; SOLVERS is the list of them."""

from collections.abc import Callable, Iterable, Mapping
from typing import Protocol

import gtsam

from ..config import Config
from ..graph import Decision, Delta, Estimate, Factor
from ..space import Space
from . import isam2


class Solver(Protocol):
    name: str  # as summary.json tells it

    @property
    def factors(self) -> Mapping[str, Factor]:
        """The store: what is in the graph now, by id."""
        ...

    def update(self, delta: Delta) -> Estimate:
        """Apply a change whole; SolverFailure, with nothing applied, names the factors that cannot be solved."""
        ...

    def polish(self) -> Estimate:
        """Linearize everything anew at the present estimate, until that changes nothing."""
        ...

    def restart(self, factors: Iterable[Factor], values: gtsam.Values) -> Estimate:
        """Hold exactly these factors from now on, linearized near these values; SolverFailure, with nothing changed."""
        ...

    def incidents(self) -> tuple[Decision, ...]:
        """What went wrong and was mended since the last call."""
        ...


SOLVERS: Mapping[str, Callable[[Config, Space], Solver]] = {
    "isam2": isam2.Isam2,
}
