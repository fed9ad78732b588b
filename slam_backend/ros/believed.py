"""A living run for core.query: the newest snapshot, the newest decisions, covariances from the worker."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core.config import Config
from ..core.decisions import as_json
from ..core.errors import SlamError, SolverFailure
from ..core.graph import Decision
from ..core.measurement import Array, format_stamp
from ..core.query import Known, Unknown
from ..core.shown import Shown
from ..core.trajectory import Snapshot
from ..io.feeder import Feeder
from ..io.historian import Historian, Question

PATIENCE = 5.0  # s that the worker may take to come to a request


class Believed(Shown):
    """Implements core.query.Known. feeder: waited for when a covariance is asked; None: no covariance is known. historian:
    waited for when something earlier is asked.
    """

    def __init__(
        self,
        snapshot: Snapshot,
        decided: Mapping[str, Decision],
        config: Config,
        feeder: Feeder | None = None,
        historian: Historian | None = None,
    ) -> None:
        super().__init__(snapshot, config)
        self._decided, self._feeder = decided, feeder
        self._config, self._historian = config, historian

    def covariance(self, index: int) -> Array:
        """Of a keyframe's pose as the worker believes it now, a little later than the snapshot."""
        if self._feeder is None:
            raise SolverFailure("there is no worker to ask for a covariance", ())
        try:
            return np.asarray(self._feeder.request("covariance", str(index), PATIENCE))
        except SlamError as error:
            raise SolverFailure(str(error), ()) from None

    def decision(self, identifier: str) -> Mapping[str, Any] | None:
        decision = self._decided.get(identifier)
        return None if decision is None else as_json(decision)

    def past(self, stamp: int) -> Known:
        if self._historian is None:
            raise Unknown(f"there is nobody to ask what was believed at {format_stamp(stamp)}")
        return Remembered(self._historian, stamp, self._config)


class Remembered(Believed):
    """The same session as it was believed at a stamp."""

    def __init__(self, historian: Historian, stamp: int, config: Config) -> None:
        """Unknown where it never was."""
        super().__init__(historian.ask(Question("snapshot", stamp)), {}, config, historian=historian)
        self._asked, self._stamp = historian, stamp

    def covariance(self, index: int) -> Array:
        try:
            return np.asarray(self._asked.ask(Question("covariance", self._stamp, str(index))))
        except SlamError as error:
            raise SolverFailure(str(error), ()) from None

    def decision(self, identifier: str) -> Mapping[str, Any] | None:
        found: Mapping[str, Any] | None = self._asked.ask(Question("decision", self._stamp, identifier))
        return found
