"""What became of the loops of a run, when it is known which of them are wrong."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ..core.graph import Decision

Label = Literal["true", "wrong", "neither"]  # neither: nobody can say, so nobody is blamed
IN = frozenset({"accepted", "restored"})


@dataclass(slots=True)
class Loop:
    """ends: its two stamps (ns). rule: stage and reason of its last verdict. first, entered: how many keyframes there were when it was decided about first, and when it entered first."""

    ends: tuple[int, int]
    label: Label
    first: int
    rule: str = ""
    entered: int | None = None
    kept: bool = False


@dataclass(slots=True)
class Tally:
    """Follows the decisions about loops. label: of the loop between two stamps."""

    label: Callable[[tuple[int, int]], Label]
    loops: dict[str, Loop] = field(default_factory=dict)
    wrong_at_most: int = 0  # wrong ones that were kept at the same moment
    _wrong_now: int = 0

    def take(self, decisions: Iterable[Decision], keyframes: int) -> None:
        """The decisions of one update, in their order."""
        for decision in decisions:
            if decision.ends is not None:
                self._one(decision, decision.ends, keyframes)
        self.wrong_at_most = max(self.wrong_at_most, self._wrong_now)

    def _one(self, decision: Decision, ends: tuple[int, int], keyframes: int) -> None:
        loop = self.loops.setdefault(decision.id, Loop(ends, self.label(ends), keyframes))
        enters = decision.verdict in IN
        if loop.label == "wrong":
            self._wrong_now += enters - loop.kept
        if enters and loop.entered is None:
            loop.entered = keyframes
        loop.kept = enters
        loop.rule = f"{decision.stage}/{decision.reason}"

    @property
    def true(self) -> int:
        return sum(loop.label == "true" for loop in self.loops.values())

    @property
    def true_kept(self) -> int:
        return sum(loop.kept and loop.label == "true" for loop in self.loops.values())

    @property
    def wrong_kept(self) -> int:
        return self._wrong_now

    @property
    def wrong_ever(self) -> int:
        """Wrong ones that were kept at some moment."""
        return sum(loop.label == "wrong" and loop.entered is not None for loop in self.loops.values())

    @property
    def precision(self) -> float:
        """Of what is kept, how much is true; 1 where nothing is kept."""
        kept = self.true_kept + self.wrong_kept
        return self.true_kept / kept if kept else 1.0

    @property
    def recall(self) -> float:
        """Of what is true, how much is kept; 1 where nothing is true."""
        return self.true_kept / self.true if self.true else 1.0

    @property
    def delays(self) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Keyframes from the first verdict about each true loop that is kept to its entry."""
        found = [
            loop.entered - loop.first
            for loop in self.loops.values()
            if loop.kept and loop.label == "true" and loop.entered is not None
        ]
        return np.array(found, dtype=np.int64)
