"""Snapshots of the worker, fetched when somebody asks: in a thread, since the worker may be busy and a large map takes a while."""

import threading
from collections.abc import Callable
from time import monotonic

from ..core.errors import SlamError
from ..io.feeder import Feeder
from .state import State

PATIENCE = 30.0  # s that the worker may take to come to a request
SHARE = 5  # of the worker's time at most one part in so many


class Snapshots:
    """Shows them in `state`. feeder_of: the present feeder, None without a session."""

    def __init__(self, state: State, feeder_of: Callable[[], Feeder | None]) -> None:
        self._state, self._feeder_of = state, feeder_of
        self._asked, self._closed = threading.Event(), threading.Event()
        threading.Thread(target=self._keep, name="snapshots", daemon=True).start()

    def ask(self) -> None:
        """For one that is newer than the last, if there is anything new; returns at once."""
        self._asked.set()

    def close(self) -> None:
        self._closed.set()
        self._asked.set()

    def _keep(self) -> None:
        shown = None
        while not self._closed.is_set():
            self._asked.wait()
            self._asked.clear()
            feeder, update = self._feeder_of(), self._state.update
            if self._closed.is_set() or feeder is None or update is None or update is shown:
                continue
            begin = monotonic()
            try:
                snapshot = feeder.request("snapshot", timeout=PATIENCE)
            except SlamError:
                continue  # the worker is being replaced; there will be another
            if feeder is self._feeder_of():
                self._state.show(snapshot)
                shown = update
            self._closed.wait((SHARE - 1) * (monotonic() - begin))
