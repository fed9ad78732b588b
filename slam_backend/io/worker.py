"""The core in a process of its own, fed from the journal.

gtsam keeps the GIL for a whole update: a thread would stall the node's callbacks for as long. Between the two go plain data:
records in; small reports out at once; a snapshot, a saved run or an optimization only when asked. The worker runs the same
stream as `replay`, so what runs live is what runs offline; a request is answered between two records, at the state of the watermark.
"""

import resource
import signal
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic
from typing import Any, Literal

from ..core.backend import Update
from ..core.command import parse
from ..core.condition import Condition
from ..core.config import Config
from ..core.consistency import blind_axes
from ..core.errors import SlamError
from ..core.graph import Decision, keyframe
from ..core.measurement import Measurement
from .cdr import Decoder
from .events import is_own
from .journal import Row
from .replay import Run
from .result import Result
from .rundir import write_run
from .typestore import typestore_of

RECENT = 1500  # factors at which the noise of the sources is looked at: some 30 ms
FIRST = 100  # factors, below which it is not
SHARE = 50  # of the worker's time at most one part in so many goes into looking at how the sources do

RequestName = Literal["snapshot", "covariance", "dry_run", "save", "finish"]


@dataclass(frozen=True, slots=True)
class Report:
    """What changed since the last one. applied: id of the newest row that was read. covariance: of the newest keyframe's pose, 36
    numbers in ROS order; None without updates, or when it is not determined. update_ms: median and p99. reached: the newest stamp (ns)
    that has been applied. consistency: by source, whether its noise is what it says, as summary.json has it; None: as before.
    conditions: how each source does (core/condition.py); None: as before.
    """

    applied: int
    updates: tuple[Update, ...]
    covariance: tuple[float, ...] | None
    decisions: tuple[Decision, ...]
    factors: int
    update_ms: tuple[float, float]
    memory_mb: float
    reached: int = 0
    consistency: Mapping[str, Any] | None = None
    conditions: Mapping[str, Condition] | None = None


@dataclass(frozen=True, slots=True)
class Request:
    """snapshot: a Snapshot. covariance: of the pose of keyframe number `argument`, at its tangent. dry_run: what the command
    `argument`, as JSON, would come to. save: write a run
    directory at `argument`. finish: the input has ended; save, and end.
    """

    id: int
    name: RequestName
    argument: str = ""


@dataclass(frozen=True, slots=True)
class Answer:
    """To the request of that id. error: one line, when it could not be done."""

    id: int
    content: Any = None
    error: str = ""


@dataclass(frozen=True, slots=True)
class Failure:
    """The last word of a worker that cannot go on: what it failed at, in one line."""

    what: str


class LiveInputs:
    """Rows and requests from a pipe, as the inputs of a Run. idle: called before each wait."""

    def __init__(
        self,
        pipe: Connection,
        journal: Path,
        table: Mapping[str, tuple[str, str]],
        idle: Callable[[], None],
        answer: Callable[[Request], Any],
    ) -> None:
        self.paths = [journal]
        self.count = self.read = self.applied = 0
        self.damage: list[str] = []
        self.last: Request | None = None
        self._pipe, self._idle, self._answer = pipe, idle, answer
        self._decoder = Decoder(typestore_of(()), table)

    def stream(self, config: Config) -> Iterator[Measurement | Decision]:  # noqa: ARG002  # the table is given
        while True:
            self._idle()
            try:
                message = self._pipe.recv()
            except EOFError:
                return  # the node is gone: the journal has everything
            if not isinstance(message, Request):
                yield from self._decoded(message)
            elif message.name == "finish":
                self.last = message
                return
            else:
                self._pipe.send(self.answered(message))

    def _decoded(self, rows: Iterable[Row]) -> Iterator[Measurement | Decision]:
        for row in rows:
            self.applied = row.id
            if row.record is not None:
                self.read += not is_own(row.record)
                yield from self._decoder.decode(row.record)

    def answered(self, request: Request) -> Answer:
        try:
            return Answer(request.id, self._answer(request))
        except (SlamError, OSError) as error:
            return Answer(request.id, error=str(error))

    def vertex(self, stamp: int) -> int | None:  # noqa: ARG002  # there is no graph file
        return None

    def close(self) -> None:
        """The pipe belongs to the process."""

    def __enter__(self) -> "LiveInputs":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Worker:
    """Runs the stream, reports after each batch of rows, answers requests."""

    def __init__(
        self, pipe: Connection, config: Config, table: Mapping[str, tuple[str, str]], journal: Path
    ) -> None:
        self._pipe = pipe
        self._inputs = LiveInputs(pipe, journal, table, self._report, self._answer)
        self._run = Run(self._inputs, config, [])
        self._updates: list[Update] = []
        self._told = 0
        self._judged = 0  # factors, when the noise of the sources was looked at last
        self._looked = (
            0.0  # s on the monotonic clock, from when on the condition of the sources is worth a look
        )

    def serve(self) -> None:
        failed = ""
        try:
            for update in self._run:
                self._updates.append(update)
        except SlamError as error:  # there was nothing to make a trajectory of
            failed = str(error)
        last = self._inputs.last
        if last is None:
            if failed:
                self._pipe.send(Failure(failed))
            return  # else the node is gone: nobody to tell
        self._report()
        self._pipe.send(Answer(last.id, error=failed) if failed else self._inputs.answered(last))

    def _report(self) -> None:
        """Send what is new, if anything is."""
        decisions = self._run.decisions.since(self._told)
        self._told += len(decisions)
        updates, self._updates = tuple(self._updates), []
        report = Report(
            self._inputs.applied,
            updates,
            self._covariance(updates[-1]) if updates else None,
            tuple(decisions),
            len(self._run.backend.solver.factors),
            self._run.seconds.recent(),
            resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            self._run.reached,
            self._consistency(),
            self._conditions(),
        )
        self._pipe.send(report)

    def _consistency(self) -> Mapping[str, Any] | None:
        """Of the newest factors, each time that half of them are new."""
        backend, last = self._run.backend, self._judged
        factors = len(backend.solver.factors)
        if factors < FIRST or last <= factors < last + min(last, RECENT // 2):
            return None
        self._judged = factors
        found = backend.recent(RECENT).consistency(blind_axes(self._run.config))
        return {source: each.as_json() for source, each in found.items()}

    def _conditions(self) -> Mapping[str, Condition] | None:
        """At most once a second, and for at most one part in SHARE of the time."""
        begin = monotonic()
        if begin < self._looked or not len(self._run.backend.timeline):
            return None
        found = self._run.backend.conditions()
        self._looked = monotonic() + max(1.0, SHARE * (monotonic() - begin))
        return found

    def _covariance(self, update: Update) -> tuple[float, ...] | None:
        backend = self._run.backend
        try:
            tangent = backend.estimate.covariance([update.keyframe.pose])
        except SlamError:
            return None
        ros = backend.space.covariance_to_ros(tangent, backend.space.pose(update.pose))
        return tuple(ros.ravel().tolist())

    def _answer(self, request: Request) -> Any:
        if request.name == "snapshot":
            return self._run.backend.snapshot()
        if request.name == "covariance":
            return self._run.backend.estimate.covariance([keyframe(int(request.argument), 0).pose])
        if request.name == "dry_run":
            asked = parse(request.argument)
            return self._run.backend.dry_run(asked.action, asked.arguments)
        result = Result(self._run)
        write_run(result, Path(request.argument))
        return result.summary


def serve(pipe: Connection, config: Config, table: Mapping[str, tuple[str, str]], journal: Path) -> None:
    """The process: topic -> (source, kind) in `table`. Ends when asked to finish, or when the node is gone."""
    for wish in (signal.SIGINT, signal.SIGTERM):
        signal.signal(wish, signal.SIG_IGN)  # Ctrl-C is the node's affair: it will ask to finish
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        _Worker(pipe, config, table, journal).serve()
    except BrokenPipeError:
        pass  # the node is gone: nobody to tell
    except Exception as error:  # noqa: BLE001  # a defect: the node says it, and starts another worker
        place = traceback.extract_tb(error.__traceback__)[-1]
        what = f"{type(error).__name__}: {' '.join(str(error).split())} at {place.filename}:{place.lineno}"
        with suppress(OSError):
            pipe.send(Failure(what))
        sys.exit(1)
