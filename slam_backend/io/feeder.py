"""Keeps a worker alive and fed: journal -> pipe -> worker -> reports.

A worker that dies is started anew and fed from the first row, so it ends where the other would have. What the dead one
had reported is not told again: the new one gets its rows up to the very row of that report, and is silent until there.
"""

import multiprocessing
import signal
import sqlite3
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import count
from multiprocessing.resource_tracker import ensure_running
from pathlib import Path
from typing import Any

from ..core.config import Config
from ..core.errors import SlamError
from .journal import Journal, JournalReader, Row
from .worker import Answer, Failure, Report, Request, RequestName, serve

BATCH = 500  # rows in one message to the worker
PATIENCE = 0.1  # s between two looks at whether to stop
FAREWELL = 1.0  # s that a worker may take to end after its last answer
LONGEST_PAUSE = 10.0  # s before a worker that dies at the same row again and again gets a successor
LOST = "the worker ended before it answered"


class _Worker:
    """One process, and how far it has come. quiet_until: the row up to which its reports have been told already."""

    def __init__(
        self, config: Config, table: Mapping[str, tuple[str, str]], journal: Path, quiet_until: int
    ) -> None:
        context = multiprocessing.get_context("spawn")  # a forked copy of DDS's threads would deadlock
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=serve, args=(theirs, config, table, journal), daemon=True)
        with undisturbed():
            self.process.start()
        theirs.close()
        self.sent = self.applied = 0
        self.quiet_until = quiet_until
        self.quiet = quiet_until > 0
        self.asked: list[int] = []  # ids of requests sent and not answered
        self.finishing = self.gone = False
        self.failure = ""

    @property
    def progress(self) -> tuple[int, str]:
        """Other than before if it gets on: rows read, and CPU time used, since to save a large map takes minutes without a row."""
        try:
            words = Path(f"/proc/{self.process.pid}/stat").read_text(encoding="ascii", errors="replace")
        except OSError:  # it is gone, or this is no Linux
            return self.applied, ""
        return self.applied, " ".join(words.rpartition(")")[2].split()[11:13])

    def end(self, patience: float = 0.0) -> None:
        """After at most `patience` s there is no process any more."""
        self.process.join(patience)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


class Feeder:
    """told: called with every Report, in a thread of its own. died: called there with one line whenever a worker was lost.
    held: the row up to which a worker is fed; None: to the end.
    """

    def __init__(
        self,
        journal: Journal,
        config: Config,
        table: Mapping[str, tuple[str, str]],
        told: Callable[[Report], None],
        died: Callable[[str], None],
        held: int | None = None,
    ) -> None:
        self._journal, self._config, self._table = journal, config, table
        self._told, self._died = told, died
        self.held = held
        self._begin = self._fed  # rows that lie behind: a request is not answered before they are read
        self._told_to = 0
        self._ids = count(1)
        self._requests: deque[Request] = deque()
        self._last: Request | None = None
        self._answers: dict[int, Answer | None] = {}  # None: still to come
        self._answered = threading.Condition()
        self._stop = threading.Event()
        self.restarts = 0
        self._worker = _Worker(config, table, journal.path, 0)
        self._thread = threading.Thread(target=self._keep, name="feeder", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        return self._worker.process.is_alive()

    @property
    def pid(self) -> int | None:
        return self._worker.process.pid

    @property
    def backlog(self) -> int:
        """Rows that the worker has not read yet."""
        return max(self._journal.ready - self._worker.applied, 0)

    @property
    def _fed(self) -> int:
        """Rows that a worker may be given."""
        held, ready = self.held, self._journal.ready
        return ready if held is None else min(held, ready)

    def pause(self, on: bool) -> None:
        """While paused, records are journaled but not fed; a worker that dies gets a successor that is fed as far as it was."""
        if not on:
            self.held = None
        elif self.held is None:
            self.held = max(self._worker.sent, self._told_to)

    def request(self, name: RequestName, argument: str = "", timeout: float = 10.0) -> Any:
        """Ask the worker, between two batches of rows. SlamError when it cannot, or not in time (s)."""
        request = Request(next(self._ids), name, argument)
        with self._answered:
            self._answers[request.id] = None
        if name == "finish":
            self._last = request
        else:
            self._requests.append(request)
        self._journal.nudge()
        answer = self._awaited(request, timeout)
        if answer is None:
            why = (
                "it has been ended"
                if self._stop.is_set()
                else f"not within {timeout:g} s: it is busy or lost"
            )
            raise SlamError(f"the worker did not answer '{name}': {why}")
        if answer.error:
            raise SlamError(answer.error)
        return answer.content

    def _awaited(self, request: Request, timeout: float) -> Answer | None:
        """None if it did not come in time (s). As long as the worker gets on, the last one has time."""

        def over() -> bool:
            return self._answers[request.id] is not None or self._stop.is_set()

        with self._answered:
            while True:
                before = self._worker.progress
                if self._answered.wait_for(over, timeout) or request is not self._last:
                    break
                if self._worker.progress == before:
                    break
            return self._answers.pop(request.id)

    def finish(self, folder: str, timeout: float) -> Any:
        """Feed what is left of the journal, flush, save the run at `folder`, end the worker; the run's summary.

        SlamError if the worker comes no further for so long (s), nor computes. One that dies meanwhile gets a successor.
        """
        self.held = None
        try:
            summary = self.request("finish", folder, timeout)
            self._worker.end(FAREWELL)
            return summary
        finally:
            self.close()

    def close(self) -> None:
        """No process and no thread is left; what was asked is not answered."""
        self._stop.set()
        self._journal.nudge()
        with self._answered:
            self._answered.notify_all()
        self._worker.end()
        if self._thread is not threading.current_thread():
            self._thread.join()

    # -- one worker after the other ----------------------------------------------------------------

    def _keep(self) -> None:
        deaths, furthest = 0, 0  # in a row, without any progress
        while True:
            worker = self._worker
            feeding = threading.Thread(target=self._feed, args=(worker,), name="rows", daemon=True)
            feeding.start()
            self._read(worker)
            worker.end(FAREWELL)
            worker.gone = True
            self._journal.nudge()
            feeding.join()
            worker.pipe.close()
            if self._stop.is_set() or self._is_finished():
                return
            deaths, furthest = (deaths + 1, furthest) if worker.applied <= furthest else (0, worker.applied)
            self._fail_requests(worker)
            self.restarts += 1
            why = worker.failure or f"it ended with code {worker.process.exitcode}"
            self._died(f"the worker was lost ({why}); another one reads the journal from its start")
            self._stop.wait(min(PATIENCE * 2**deaths, LONGEST_PAUSE) if deaths else 0)
            self._worker = _Worker(self._config, self._table, self._journal.path, self._told_to)
            if self._stop.is_set():
                self._worker.end()  # close() may have seen the one before only

    def _is_finished(self) -> bool:
        """Whether the last request has been answered, or its asker is gone."""
        last = self._last
        return last is not None and self._answers.get(last.id, Answer(last.id)) is not None

    def _fail_requests(self, worker: _Worker) -> None:
        with self._answered:
            for asked in worker.asked:
                if asked in self._answers and not (self._last and asked == self._last.id):
                    self._answers[asked] = Answer(asked, error=LOST)
            self._answered.notify_all()

    # -- to the worker -----------------------------------------------------------------------------

    def _feed(self, worker: _Worker) -> None:
        """A thread for each worker: the only one that writes to its pipe."""
        with suppress(OSError):  # the pipe is broken: the reading thread sees its end too
            while not (worker.gone or self._stop.is_set()):
                try:
                    self._feed_from(JournalReader(self._journal.path), worker)
                    self._stop.wait(PATIENCE)
                except sqlite3.Error as error:
                    self._died(f"{self._journal.path}: cannot be read: {error}")
                    self._stop.wait(LONGEST_PAUSE)

    def _feed_from(self, reader: JournalReader, worker: _Worker) -> None:
        try:
            while not (worker.gone or self._stop.is_set()):
                request = self._due(worker)
                if request is not None:
                    worker.asked.append(request.id)
                    worker.pipe.send(request)
                elif (ready := self._fed - worker.sent) > 0:
                    left = worker.quiet_until - worker.sent
                    rows = self._rows(reader, worker.sent, min(BATCH, ready, left if left > 0 else BATCH))
                    if not rows:
                        return  # the file has moved: it is opened again
                    worker.pipe.send(rows)
                    worker.sent = rows[-1].id
                else:
                    after = worker.sent if self.held is None else self._journal.ready
                    self._journal.wait(after, PATIENCE, lambda: bool(self._requests) or worker.gone)
        finally:
            reader.close()

    def _rows(self, reader: JournalReader, after: int, limit: int) -> list[Row]:
        """From the file; in trouble those beyond it from memory."""
        rows = self._journal.unwritten(after, limit) or reader.after(after, limit)
        for row in rows:
            if row.record is None:
                self._died(f"{self._journal.path}: row {row.id} does not match its checksum: it is left out")
        return rows

    def _due(self, worker: _Worker) -> Request | None:
        """The next request, once the worker has been given what a former one had read; the last one after all rows."""
        if worker.sent < max(worker.quiet_until, self._begin):
            return None
        while self._requests:
            request = self._requests.popleft()
            if request.id in self._answers:  # else its asker has given up
                return request
        if self._last is None or worker.finishing or worker.sent < self._journal.ready:
            return None
        worker.finishing = True
        return self._last

    # -- from the worker ---------------------------------------------------------------------------

    def _read(self, worker: _Worker) -> None:
        with suppress(EOFError, OSError):
            while True:
                message = worker.pipe.recv()
                if isinstance(message, Report):
                    self._report(worker, message)
                elif isinstance(message, Failure):
                    worker.failure = message.what
                else:
                    self._answer(worker, message)

    def _report(self, worker: _Worker, report: Report) -> None:
        worker.applied = report.applied
        if not worker.quiet:
            self._told_to = report.applied
            self._told(report)
        elif report.applied >= worker.quiet_until:
            worker.quiet = False

    def _answer(self, worker: _Worker, answer: Answer) -> None:
        with self._answered:
            worker.asked.remove(answer.id)
            if answer.id in self._answers:  # else its asker has given up
                self._answers[answer.id] = answer
                self._answered.notify_all()


@contextmanager
def undisturbed() -> Iterator[None]:
    """Start processes that SIGINT and SIGTERM do not reach before they have said what these are to do there."""
    ensure_running()  # multiprocessing's own process, whose start would undo the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
