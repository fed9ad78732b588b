"""One journal, and the worker that reads it."""

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from uuid import uuid4

from ..core.command import TOPIC, TYPE, command, text_of
from ..core.config import Config
from ..core.errors import BadFile, SlamError
from ..core.graph import Decision
from ..core.sensors import SENSORS
from ..io.encode import encode_string
from ..io.feeder import Feeder
from ..io.inputs import OWN
from ..io.journal import NAME as JOURNAL
from ..io.journal import Journal
from .state import State

RUN = "run"  # the folder, beside the journal, of the run that is saved at the end


class Session:
    """incident: told in words when something went wrong, from any thread."""

    def __init__(self, folder: Path, state: State, incident: Callable[[str], None]) -> None:
        """An earlier session's journal and run are set aside. BadFile where the folder cannot be used."""
        self._state, self._incident, self._folder = state, incident, folder
        _set_aside(folder)
        self.journal = Journal(folder, incident)
        self.feeder: Feeder | None = None
        self._lock, self._ended = threading.Lock(), False

    def work(self, config: Config) -> None:
        """A worker for these sources; one that runs already is replaced, and the new one reads the journal from its start."""
        table = dict(OWN) | {source.topic: (name, source.kind) for name, source in config.sources.items()}
        with self._lock:
            if self._ended:
                return
            held = 0 if self._state.paused else None
            if self.feeder is not None:
                held = self.feeder.held
                self.feeder.close()
            self.journal.announce(
                {
                    source.topic: next(iter(SENSORS[source.kind].decoders))
                    for source in config.sources.values()
                }
            )
            self._state.expect(self.journal.committed)
            self.feeder = Feeder(self.journal, config, table, self._state.take, self._incident, held)
            self.feeder.pause(self._state.paused)  # as it is by now

    def command(self, action: str, arguments: Mapping[str, Any], seconds: float) -> Decision:
        """Journal what a person asks, and wait for what came of it. Any thread but the executor's.

        SlamError where it cannot be carried out, or not in time (s): then it still will be.
        """
        if self._state.update is None or self.feeder is None:
            raise SlamError(
                f"there is nothing to {action} yet: no message of the driving source has been accepted"
            )
        if self._state.paused:
            raise SlamError("the inputs are paused, and a command waits behind them: resume first")
        if self.journal.trouble:
            raise SlamError(self.journal.trouble)
        asked = command(uuid4().hex, action, arguments)
        if not self.journal.append(TOPIC, TYPE, encode_string(text_of(asked))):
            raise SlamError("the session is ending")
        name = f"command/{asked.id}"
        decision = self._state.decision(name, seconds, unless=lambda: self._ended)
        if decision is None:
            raise SlamError(
                f"not carried out {self._why_not(seconds)}; it is in the journal: ask for decision/{name}"
            )
        return decision

    def _why_not(self, seconds: float) -> str:
        feeder = self.feeder
        if self._ended or feeder is None:
            return "before the session ended"
        late = f"within {seconds:g} s"
        if self.journal.trouble:
            return f"{late}: {self.journal.trouble}"
        if self._state.paused:
            return f"{late}: the inputs have been paused"
        return f"{late}: the worker is {'busy' if feeder.alive else 'down'}, {feeder.backlog} records behind"

    def end(self, seconds: float) -> Any:
        """Close the journal, let the worker read it to its end and save; the run's summary, None if nothing was heard.

        SlamError if that did not work, or not in time (s).
        """
        with self._lock:
            self._ended = True
        self.journal.close()
        if self.feeder is None:
            return None
        if not self.journal.committed:
            self.feeder.close()
            return None
        return self.feeder.finish(str(self._folder / RUN), seconds)


def _set_aside(folder: Path) -> None:
    """What an earlier session left keeps its place in the folder, under the next free number."""
    n = 1
    while any((folder / name).exists() for name in (f"journal-{n}.db3", f"{RUN}-{n}")):
        n += 1
    names = {f"{JOURNAL}{ending}": f"journal-{n}.db3{ending}" for ending in ("", "-wal", "-shm")}
    for name, kept in {**names, RUN: f"{RUN}-{n}"}.items():
        try:
            if (folder / name).exists():
                (folder / name).rename(folder / kept)
        except OSError as error:
            raise BadFile(f"{folder / name}: cannot be set aside: {error.strerror}") from None
