"""What a living session believed earlier, from its journal, in a process of its own: the worker and the node go on meanwhile.

The process starts with the first question. It stands where it was asked last, so that the next question about something later is
cheap; left alone for a while, it lets go of the journal.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

from ..core.config import Config
from ..core.errors import SlamError
from ..core.measurement import format_stamp
from ..core.query import Unknown
from .feeder import undisturbed
from .inputs import open_inputs
from .past import Past
from .replay import Cut, Run

PATIENCE = 600.0  # s that a replay to the moment in question may take
IDLE = 30.0  # s without a question after which the journal is let go
LOOK = 0.2  # s between two looks at whether to stop
NICE = 10  # of processes that answer somebody who waits anyway: node and worker come first


@dataclass(frozen=True, slots=True)
class Question:
    """snapshot: of what was believed at a stamp (ns). covariance: of the pose of keyframe number `argument`, at its tangent.
    decision: the last one, by then, about the factor `argument`.
    """

    what: Literal["snapshot", "covariance", "decision"]
    stamp: int
    argument: str = ""


class Historian:
    """Ask from any thread but the executor's: it waits."""

    def __init__(self, journal: Path, config: Config, reached: Callable[[], int]) -> None:
        """reached: the newest stamp (ns) that the session itself has applied."""
        self._arguments, self._reached = (journal, config), reached
        self._one, self._stop = threading.Lock(), threading.Event()
        self._process: Any = None
        self._pipe: Connection | None = None

    def ask(self, question: Question) -> Any:
        """Unknown where the session never was, or is not yet; SlamError where it cannot be told."""
        if question.stamp > (reached := self._reached()):
            raise Unknown(
                f"{format_stamp(question.stamp)} lies ahead: {format_stamp(reached)} is what has been applied"
            )
        with self._one:
            try:
                answer = self._asked(question)
            except (EOFError, OSError):
                self._end()
                raise SlamError("the process that looks into the past ended before it answered") from None
        if isinstance(answer, SlamError):
            raise answer
        return answer

    def close(self) -> None:
        """No process is left; who asks gets a SlamError."""
        self._stop.set()
        with self._one:
            self._end()

    def _asked(self, question: Question) -> Any:
        pipe = self._pipe or self._begin()
        pipe.send(question)
        for _ in range(round(PATIENCE / LOOK)):
            if pipe.poll(LOOK):
                return pipe.recv()
            if self._stop.is_set():
                break
        self._end()
        return SlamError(
            "the session has ended" if self._stop.is_set() else f"not told within {PATIENCE:g} s"
        )

    def _begin(self) -> Connection:
        context = multiprocessing.get_context("spawn")
        pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, *self._arguments), daemon=True)
        with undisturbed():
            self._process.start()
        theirs.close()
        self._pipe = pipe
        return pipe

    def _end(self) -> None:
        if self._pipe is not None:
            self._pipe.close()
            self._process.kill()
            self._process.join()
            self._pipe = None


def serve(pipe: Connection, journal: Path, config: Config) -> None:
    """The process; ends when the node is gone, or by SIGTERM: it holds nothing that could be lost."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the node's affair
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
    os.nice(NICE)

    def begin() -> Run:
        return Run(open_inputs([journal]), config, [], cut=Cut(flush=False))

    past = Past(begin)
    with suppress(EOFError, OSError):
        while True:
            if not pipe.poll(IDLE):
                past = Past(begin)
                pipe.poll(None)
            question: Question = pipe.recv()
            try:
                answer = _answer(past, question)
            except SlamError as error:
                answer = type(error)(str(error)) if isinstance(error, Unknown) else SlamError(str(error))
            pipe.send(answer)


def _answer(past: Past, question: Question) -> Any:
    then = past.at(question.stamp)
    if question.what == "snapshot":
        return then.snapshot
    if question.what == "covariance":
        return then.covariance(int(question.argument))
    decision: Mapping[str, Any] | None = then.decision(question.argument)
    return decision
