"""Keeps a worker alive and fed: journal -> pipe -> worker -> reports.

Two threads: one feeds rows from the journal, one reads what comes back. A worker that dies is started anew and fed
from the first row, so it ends where the other would have.
"""

import multiprocessing
import threading
from collections.abc import Callable, Mapping
from itertools import count
from multiprocessing.connection import Connection
from typing import Any

from ..core.config import Config
from ..core.errors import SlamError
from .journal import Journal, JournalReader
from .worker import Answer, Report, Request, RequestName, serve

BATCH = 500  # rows in one message to the worker
PATIENCE = 0.1  # s between two looks at whether to stop


class Feeder:
    """told: called with every Report, in a thread of its own. died: called with one line whenever a worker was lost."""

    def __init__(
        self,
        journal: Journal,
        config: Config,
        table: Mapping[str, tuple[str, str]],
        told: Callable[[Report], None],
        died: Callable[[str], None],
    ) -> None:
        self._journal, self._config, self._table = journal, config, table
        self._told, self._died = told, died
        self._ids = count(1)
        self._answers: dict[int, Answer] = {}
        self._answered = threading.Condition()
        self._sending = threading.Lock()
        self._stop = threading.Event()
        self._hold = threading.Event()  # set while paused
        self.sent = 0
        self.restarts = 0
        self._start()

    @property
    def alive(self) -> bool:
        return self._process.is_alive()

    @property
    def pid(self) -> int | None:
        return self._process.pid

    @property
    def backlog(self) -> int:
        """Rows that the worker has not read yet."""
        return max(self._journal.committed - self._applied, 0)

    def pause(self, on: bool) -> None:
        """While paused, records are journaled but not fed."""
        self._hold.set() if on else self._hold.clear()

    def request(self, name: RequestName, argument: str = "", timeout: float = 10.0) -> Any:
        """Ask the worker, between two records. SlamError when it cannot, or not in time (s)."""
        request = Request(next(self._ids), name, argument)
        self._send(request)
        with self._answered:
            if not self._answered.wait_for(lambda: request.id in self._answers or not self.alive, timeout):
                raise SlamError(
                    f"the worker did not answer '{name}' within {timeout:g} s: it is busy or lost"
                )
            answer = self._answers.pop(request.id, Answer(request.id, error="the worker ended before it answered"))
        if answer.error:
            raise SlamError(answer.error)
        return answer.content

    def finish(self, folder: str, timeout: float) -> Any:
        """Feed what is left of the journal, flush, save the run at `folder`, end the worker; the run's summary."""
        self._hold.clear()
        while self.sent < self._journal.committed and self._process.is_alive():
            self._stop.wait(PATIENCE / 10)
        self._stop.set()
        try:
            return self.request("finish", folder, timeout)
        finally:
            self.close()

    def close(self) -> None:
        self._stop.set()
        self._pipe.close()
        self._process.join(1.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")  # a forked copy of DDS's threads would deadlock
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, self._config, self._table), daemon=True)
        self._process.start()
        theirs.close()
        self.sent = self._applied = 0
        for work in (self._feed, self._read):
            threading.Thread(target=work, args=(self._pipe,), name=work.__name__, daemon=True).start()

    def _send(self, message: Any) -> None:
        try:
            with self._sending:
                self._pipe.send(message)
        except OSError as error:
            raise SlamError(f"the worker is lost: {error}") from None

    def _feed(self, pipe: Connection) -> None:
        """One thread for each worker, until it is lost or there is no more to come."""
        reader = JournalReader(self._journal.path)
        while pipe is self._pipe and not (self._stop.is_set() and self.sent >= self._journal.committed):
            if self._hold.is_set() or not self._journal.wait(self.sent, PATIENCE):
                self._stop.wait(PATIENCE if self._hold.is_set() else 0)
                continue
            rows = reader.after(self.sent, BATCH)
            try:
                self._send(rows)
            except SlamError:
                break  # the reading thread sees the end of the pipe, and starts another worker
            self.sent = rows[-1].id
        reader.close()

    def _read(self, pipe: Connection) -> None:
        while True:
            try:
                message = pipe.recv()
            except (EOFError, OSError):
                break
            if isinstance(message, Report):
                self._applied = message.applied
                self._told(message)
            else:
                with self._answered:
                    self._answers[message.id] = message
                    self._answered.notify_all()
        with self._answered:
            self._answered.notify_all()
        if not self._stop.is_set():
            self._process.join()
            code = self._process.exitcode
            self.restarts += 1
            self._died(f"the worker ended with code {code}; another one reads the journal from its start")
            self._start()
