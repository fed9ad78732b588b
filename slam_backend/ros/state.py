"""What the node's callbacks read: the newest answers of the worker, written by other threads."""

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from time import monotonic
from typing import Any

from ..core.backend import Update
from ..core.condition import Condition
from ..core.firewall.rules import rule_of
from ..core.graph import Decision
from ..core.trajectory import Snapshot
from ..io.worker import Report

LOOK = 0.1  # s between two looks at whether to go on waiting
DECISIONS = 10_000  # the newest that can be asked for by id
REVISIONS = 1_000  # the newest that are listed


class State:
    """Thread-safe by replacing whole values. changed: called after each report, from the reading thread."""

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed = changed
        self._lock = threading.Condition()  # notified of each report
        self.report: Report | None = None
        self.update: Update | None = None
        self.covariance: tuple[float, ...] | None = None  # 36, ROS order, of the newest keyframe
        self.snapshot: Snapshot | None = None
        self.consistency: Mapping[str, Any] = {}  # by source, as summary.json has it
        self.conditions: Mapping[str, Condition] = {}  # by source
        self.decided: dict[str, Decision] = {}
        self.refused: dict[tuple[str, str], int] = {}  # (source, stage/reason) -> count
        self.noted: dict[tuple[str, str], int] = {}  # the same for what the firewall kept, with a remark
        self.revisions: deque[int] = deque(
            maxlen=REVISIONS
        )  # stamps at which the map was noticeably corrected
        self.incidents: deque[tuple[float, str]] = deque(
            maxlen=100
        )  # s on the monotonic clock, what happened
        self.paused = False  # inputs are journaled but not applied; outlasts a session
        self._untold: list[Decision] = []
        self._revision = 0
        self._unshown = False
        self._newest: tuple[Update, tuple[float, ...] | None] | None = None  # of the worker; perhaps not news
        self._behind = 0  # rows that a new worker has yet to read before its updates are news

    def take(self, report: Report) -> None:
        with self._lock:
            self.report = report
            self.consistency = self.consistency if report.consistency is None else report.consistency
            self.conditions = self.conditions if report.conditions is None else report.conditions
            self._note(report.updates)
            if report.updates:
                self._newest = report.updates[-1], report.covariance
            if self._newest is not None and report.applied >= self._behind:
                self.update, self.covariance = self._newest
            for decision in report.decisions:
                self._decide(decision)
            self._lock.notify_all()
        self._changed()

    @property
    def applied(self) -> int:
        """Rows that the worker has read."""
        return self.report.applied if self.report is not None else 0

    @property
    def restored(self) -> float:
        """How much of what a new worker has to catch up with it has read; 1 when it is done."""
        return min(self.applied / self._behind, 1.0) if self._behind else 1.0

    def reached(self) -> int:
        """The newest stamp (ns) that the worker has applied."""
        report = self.report
        return report.reached if report else 0

    def _note(self, updates: Sequence[Update]) -> None:
        for update in updates:
            if update.revision != self._revision:
                self._revision = update.revision
                self.revisions.append(update.keyframe.stamp)

    def decision(self, id_: str, seconds: float, unless: Callable[[], bool]) -> Decision | None:
        """Wait for the decision with that id; None if it did not come in time (s), or something else is true."""
        until = monotonic() + seconds
        with self._lock:
            while (found := self.decided.get(id_)) is None and monotonic() < until and not unless():
                self._lock.wait(min(LOOK, max(until - monotonic(), 0.0)))
        return found

    def expect(self, rows: int) -> None:
        """A worker begins anew, with other sources: what was decided will be decided again; the newest pose holds until
        it has read so many rows.
        """
        with self._lock:
            self._behind, self._newest = rows, None
            self.decided, self.refused, self.noted, self._untold = {}, {}, {}, []
            self._revision = 0
            self.revisions.clear()

    def happen(self, what: str, decision: Decision | None = None) -> None:
        """Something went wrong."""
        with self._lock:
            self.incidents.append((monotonic(), what))
            if decision is not None:
                self._decide(decision)
        self._changed()

    def show(self, snapshot: Snapshot) -> None:
        """A newer snapshot has come; it is to be published once."""
        with self._lock:
            self.snapshot, self._unshown = snapshot, True
        self._changed()

    def take_snapshot(self) -> Snapshot | None:
        """The newest snapshot, if it has not been published yet."""
        with self._lock:
            unshown, self._unshown = self._unshown, False
            return self.snapshot if unshown else None

    def clear(self) -> None:
        """A new session."""
        with self._lock:
            self.report = self.update = self.covariance = self.snapshot = None
            self.decided, self.refused, self.noted, self._untold = {}, {}, {}, []
            self._revision = 0
            self.revisions.clear()
            self._unshown, self._behind, self._newest = False, 0, None
            self.consistency, self.conditions = {}, {}

    def untold_decisions(self) -> list[Decision]:
        """Those that have not been published yet; each is handed out once."""
        with self._lock:
            untold, self._untold = self._untold, []
        return untold

    def _decide(self, decision: Decision) -> None:
        self._untold.append(decision)
        self.decided[decision.id] = decision
        id_ = f"{decision.stage}/{decision.reason}"
        refused = decision.verdict in ("refused", "removed")
        if refused or rule_of(id_) is not None:
            counts, rule = self.refused if refused else self.noted, (decision.source, id_)
            counts[rule] = counts.get(rule, 0) + decision.count
        while len(self.decided) > DECISIONS:
            del self.decided[next(iter(self.decided))]
