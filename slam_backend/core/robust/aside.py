"""Judgments that take longer than a keyframe has: begun at one keyframe, a step at each that follows, landed a fixed number later.

So the result is a function of the data alone, and no update waits for more than its share, but the one that lands. Loops wait
until then; those in the graph are judged again with them. At the end of the input all are judged once more.
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import gtsam

from ..graph import Decision, Delta, Estimate, Factor, Verdict
from .paths import Paths
from .stage import Judged


class Opinion(NamedTuple):
    """About one loop."""

    keep: bool
    reason: str
    detail: str
    statistic: float
    threshold: float


IN: frozenset[Verdict] = frozenset({"accepted", "restored"})
Judgment = Generator[None, None, Mapping[str, Opinion]]  # a step at each `next`; opinions by id
Judge = Callable[
    [Sequence[Factor], Sequence[Factor], gtsam.Values], Judgment
]  # (all others, loops, estimate)


@dataclass(slots=True)
class Work:
    steps: Judgment
    lands: int  # at which review


class Aside:
    kinds = frozenset({"loop"})

    def __init__(self, stage: str, paths: Paths, judge: Judge, every: int, lag: int) -> None:
        """every: keyframes between two judgments, where there is a new loop. lag: keyframes from begin to landing."""
        self._stage, self._paths, self._judge = stage, paths, judge
        self._every, self._lag = every, lag
        self._loops: dict[str, Factor] = {}  # all that were ever offered
        self._told: dict[str, Verdict] = {}
        self._new = False  # since the last judgment began
        self._reviews = 0
        self._work: Work | None = None

    def admit(self, proposed: Delta, estimate: Estimate) -> Judged:  # noqa: ARG002  # judged later
        decisions = []
        for loop in proposed.add:
            self._loops[loop.id] = loop
            self._new = True
            words = f"judged within {self._every + self._lag} keyframes, together with the others"
            decisions.append(self._say(loop, "probation", Opinion(False, "waits", words, 0.0, 0.0)))
        return Delta(remove=proposed.remove), tuple(decisions)

    def review(self, estimate: Estimate) -> Judged:
        self._reviews += 1
        if self._paths.ended:
            if self._new:
                self._work = Work(self._begun(estimate), self._reviews)
        elif self._work is None and self._new and self._reviews % self._every == 0:
            self._work = Work(self._begun(estimate), self._reviews + self._lag)
        if self._work is None:
            return Delta(), ()
        opinions = self._advanced(self._work, self._paths.ended or self._reviews >= self._work.lands)
        if opinions is None:
            return Delta(), ()
        self._work = None
        return self._landed(opinions)

    def _begun(self, estimate: Estimate) -> Judgment:
        self._new = False
        """From odometry, not from the estimate: that is bent by the verdicts so far, and would repeat them."""
        from ..solvers.initialize import initialize

        self._disown()
        held = self._paths.factors
        others = [factor for id_, factor in held.items() if id_ not in self._loops]
        loops = tuple(self._loops.values())
        return self._judge(others, loops, initialize([*others, *loops], estimate.values(), "odometry").values)

    def _disown(self) -> None:
        """What was let in and is gone was taken out by a person or the solver."""
        held, told = self._paths.factors, self._told
        self._loops = {id_: f for id_, f in self._loops.items() if id_ in held or told[id_] not in IN}

    @staticmethod
    def _advanced(work: Work, to_the_end: bool) -> Mapping[str, Opinion] | None:
        """The opinions when it lands; a judgment that is ready early waits for its keyframe."""
        while True:
            try:
                next(work.steps)
            except StopIteration as end:
                found: Mapping[str, Opinion] = end.value
                if to_the_end:
                    return found
                work.steps = _ready(found)
                return None
            if not to_the_end:
                return None

    def _landed(self, opinions: Mapping[str, Opinion]) -> Judged:
        add: list[Factor] = []
        remove: list[str] = []
        decisions: list[Decision] = []
        self._disown()
        for id_, opinion in opinions.items():
            if id_ not in self._loops:
                continue
            loop, held = self._loops[id_], id_ in self._paths.factors
            if opinion.keep and not held:
                add.append(loop)
                verdict: Verdict = "restored" if self._told[id_] in ("removed", "refused") else "accepted"
                decisions.append(self._say(loop, verdict, opinion))
            elif held and not opinion.keep:
                remove.append(id_)
                decisions.append(self._say(loop, "removed", opinion))
            elif not opinion.keep and self._told[id_] == "probation":
                decisions.append(self._say(loop, "refused", opinion))
        return Delta(tuple(add), tuple(remove)), tuple(decisions)

    def _say(self, loop: Factor, verdict: Verdict, opinion: Opinion) -> Decision:
        self._told[loop.id] = verdict
        return Decision(
            loop.stamp, loop.id, loop.source, verdict, self._stage, opinion.reason, opinion.detail,
            opinion.statistic, opinion.threshold, loop.stamps,
        )  # fmt: skip


def _ready(opinions: Mapping[str, Opinion]) -> Judgment:
    """A judgment that is done."""
    yield
    return opinions
