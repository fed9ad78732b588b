"""Every decision of a run, in bounded memory, and as text."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

from .graph import Decision
from .measurement import SECOND, format_stamp

# stages that a flood of bad messages can fill
ABOUT_RECORDS = frozenset(
    {
        "decode",
        "check",
        "settle",
        "recheck",
        "landmark",
        "odometry",
        "pose",
        "gnss",
        "imu",
        "pixels",
        "session",
        "association",
    }
)

EVERYDAY = ("doubt", "expected")  # a fix that is where it should be: ten a second, for days


class DecisionLog:
    """Decisions about factors are all kept; those about records are kept once per rule, source and second, counted."""

    def __init__(self) -> None:
        self._kept: list[Decision] = []
        self._floods: dict[tuple[str, str, str, int], int] = {}

    def add(self, decision: Decision) -> None:
        if decision.stage in ABOUT_RECORDS or (decision.stage, decision.reason) == EVERYDAY:
            key = (decision.source, decision.stage, decision.reason, decision.stamp // SECOND)
            if (at := self._floods.get(key)) is not None:
                first = self._kept[at]
                self._kept[at] = replace(first, count=first.count + decision.count)
                return
            self._floods[key] = len(self._kept)
        self._kept.append(decision)

    def extend(self, decisions: Iterable[Decision]) -> None:
        for decision in decisions:
            self.add(decision)

    def __iter__(self) -> Iterator[Decision]:
        return iter(self._kept)

    def __len__(self) -> int:
        return len(self._kept)

    def since(self, count: int) -> list[Decision]:
        """Those after the first `count`."""
        return self._kept[count:]

    def by_rule(self) -> dict[str, int]:
        """`stage/reason` -> how often, sorted."""
        counts: Counter[str] = Counter()
        for decision in self._kept:
            counts[f"{decision.stage}/{decision.reason}"] += decision.count
        return dict(sorted(counts.items()))

    def loops(self) -> dict[str, int]:
        """Verdict -> number of relative measurements for which it is the last one."""
        last: dict[Any, Decision] = {}
        for d in self._kept:
            if d.ends is not None:  # one about a record stands for all of its second, whatever id it has
                last[(d.id, d.reason) if d.stage in ABOUT_RECORDS else d.id] = d
        counts: Counter[str] = Counter()
        for decision in last.values():
            counts[decision.verdict] += decision.count
        return dict(counts)


def as_json(decision: Decision) -> dict[str, Any]:
    """A line of decisions.jsonl."""
    line: dict[str, Any] = {
        "stamp": format_stamp(decision.stamp),
        "id": decision.id,
        "source": decision.source,
        "verdict": decision.verdict,
        "stage": decision.stage,
        "reason": decision.reason,
        "statistic": decision.statistic,
        "threshold": decision.threshold,
        "detail": decision.detail,
    }
    if decision.ends is not None:
        line["a"], line["b"] = (format_stamp(stamp) for stamp in decision.ends)
    if decision.basis:
        line["basis"] = dict(decision.basis)
    if decision.count > 1:
        line["count"] = decision.count
    return line
