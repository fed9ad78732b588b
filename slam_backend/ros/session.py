"""One journal, and the worker that reads it."""

import os
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from uuid import uuid4

from ..core.command import LOAD, TOPIC, TYPE, command, text_of
from ..core.config import Config, config_hash, config_to
from ..core.errors import BadFile, SlamError
from ..core.graph import Decision
from ..core.sensors import SENSORS
from ..io.encode import encode_string
from ..io.feeder import Feeder
from ..io.historian import Historian
from ..io.inputs import OWN
from ..io.journal import Journal
from ..io.restore import RUN, Examination, claim, salvage, set_aside, unfinished
from ..io.result import versions
from .state import State

Begin = Callable[["Session"], object]  # what is journaled before anything is heard


class Session:
    """incident: told in words when something went wrong, from any thread. past: what there was of it when it was taken up again."""

    def __init__(
        self,
        folder: Path,
        state: State,
        incident: Callable[[str], None],
        config: Config,
        *,
        fresh: bool = False,
    ) -> None:
        """Goes on with the session in the folder, if that was not ended; else its journal and run are set aside.

        fresh: a new session in any case. BadFile where the folder cannot be used.
        """
        self._state, self._incident, self._folder = state, incident, folder
        self._claim = claim(folder)
        try:
            self.past = None if fresh else self._taken_up(config)
            if self.past is None:
                set_aside(folder)
            self.journal = Journal(folder, incident, config.journal)
        except BadFile:
            self._claim.close()
            raise
        self.journal.note({"event": "resume" if self.past else "begin", "versions": versions()})
        self.feeder: Feeder | None = None
        self.historian: Historian | None = None
        self._lock, self._ended = threading.Lock(), False

    def _taken_up(self, config: Config) -> Examination | None:
        try:
            past = unfinished(self._folder, config.journal.resume)
        except BadFile as error:
            self._incident(f"{error}; it is set aside, and a new session begins")
            return None
        if past is None:
            return None
        if not config.sources and past.config is None:
            self._incident(
                f"{past.path}: is not gone on with: neither it nor the configuration names its sources"
            )
            return None
        if past.damage:
            self._incident(salvage(past))
        return past

    def config(self, given: Config) -> Config:
        """With the sources that were found before, where none are given."""
        before = self.past.config if self.past is not None else None
        return given.model_copy(update={"sources": before.sources}) if before and not given.sources else given

    def work(self, config: Config) -> None:
        """A worker for these sources; one that runs already is replaced, and the new one reads the journal from its start."""
        table = dict(OWN) | {
            topic: (name, source.kind) for name, source in config.sources.items() for topic in source.topics
        }
        with self._lock:
            if self._ended:
                return
            held = 0 if self._state.paused else None
            if self.feeder is not None:
                held = self.feeder.held
                self.feeder.close()
            self.journal.announce(
                {
                    topic: type_
                    for source in config.sources.values()
                    for topic, type_ in zip(source.topics, SENSORS[source.kind].decoders, strict=False)
                }
            )
            if self.historian is not None:
                self.historian.close()
            self.historian = Historian(self.journal.path, config, self._state.reached)
            driving = [config.sources[config.driver].topic] if config.driver else []
            self.journal.protected = (*driving, *OWN)
            self.journal.note({"event": "config", "config": config_to(config), "hash": config_hash(config)})
            self._state.expect(self.journal.committed)
            self.feeder = Feeder(self.journal, config, table, self._state.take, self._incident, held)
            self.feeder.pause(self._state.paused)  # as it is by now

    def begin_in(self, run: Path, run_hash: str) -> str:
        """Journal, before all else, that the session goes on in the map of a run; the id of the decision to come."""
        asked = command(
            uuid4().hex, LOAD, {"run": os.path.relpath(run, self._folder.resolve()), "run_hash": run_hash}
        )
        self.journal.append(TOPIC, TYPE, encode_string(text_of(asked)))
        return f"command/{asked.id}"

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

        SlamError if that did not work, or came no further for so long (s).
        """
        with self._lock:
            self._ended = True
            if self.historian is not None:
                self.historian.close()
        self.journal.close({"event": "end"})
        try:
            if self.feeder is None:
                return None
            if not self.journal.heard:
                self.feeder.close()
                return None
            return self.feeder.finish(str(self._folder / RUN), seconds)
        finally:
            self._claim.close()


def empty(session: Session) -> None:
    """A session that begins with an empty map."""
