"""The witness: a far loop enters only with others that agree with it over short odometry; a near one at once.

Near is a loop whose end the graph already knows to within `witness.near`, so that what passes the gate cannot be far off.
Nothing tells a true far loop from a false one but other loops: a place that looks like another one looks so from one spot;
a robot that really came back sees the same place again a few metres on, and what it sees there agrees with its odometry.
"""

from collections.abc import Iterable

import numpy as np

from ..config import Config
from ..graph import Decision, Delta, Estimate, Factor
from .accord import Ruler
from .chi2 import chi2_quantile
from .held import Held
from .paths import Path, Paths
from .stage import Judged, judged

SHARPER = 3.0  # how much surer than the gate odometry between two loops must be, for them to be witnesses
GLANCES = 8  # of what waits, whether the graph has come to expect it, with each loop that enters


class Witness:
    kinds = frozenset({"loop"})

    def __init__(self, config: Config, paths: Paths) -> None:
        self._config, self._paths = config.witness, paths
        self._ruler = Ruler(paths.space, config.gate, paths.usual, config.witness.near)
        self._lone = chi2_quantile(self._config.lone, paths.space.dimension) if self._config.lone else 0.0
        self._known = Held(paths, config)  # in the graph or waiting
        self._waiting: dict[str, float] = {}  # how far off (m) the graph may be about where they end
        self._fresh: list[Factor] = []  # not told about yet
        self._round: list[str] = []  # of what waits, whose turn comes yet
        self._glances: list[str] = []  # the same, of a shorter look
        self._entered = self._left = 0  # of what came into the graph, and went
        self._changes = 0  # of the graph's loops, when it was last somebody's turn

    def admit(self, proposed: Delta, estimate: Estimate) -> Judged:
        """Near loops; all others wait for the review that follows, which decides about them."""
        kept, decisions = [], []
        for loop in proposed.add:
            decision = self._alone(loop, estimate)
            if decision is None:
                self._known.add(loop)
                self._waiting[loop.id] = np.inf
                self._fresh.append(loop)
            else:
                kept.append(loop)
                decisions.append(decision)
        return Delta(tuple(kept), proposed.remove, proposed.values), tuple(decisions)

    def review(self, estimate: Estimate) -> Judged:
        """What waits is looked at again when it is new, or when a loop beside it has entered."""
        fresh, self._fresh = self._fresh, []
        entering: dict[str, Decision] = {}
        for loop in (*fresh, *self._stirred(), *self._turn(estimate)):
            if loop.id in self._waiting and loop.id not in entering:
                decision = self._alone(loop, estimate)
                entering |= {loop.id: decision} if decision else self._witnessed(loop)
        for id_ in entering:
            del self._waiting[id_]
        held = tuple(self._probation(loop) for loop in fresh if loop.id in self._waiting)
        add = tuple(self._known[id_] for id_ in entering)
        return Delta(add), (*entering.values(), *held, *self._crowded())

    def _stirred(self) -> Iterable[Factor]:
        """Waiting loops beside one that has entered since the last review."""
        entered, left = self._paths.entered[self._entered :], self._paths.left[self._left :]
        self._entered, self._left = len(self._paths.entered), len(self._paths.left)
        for loop in left:
            if loop.id not in self._waiting and loop.id not in self._paths.loops:
                self._known.drop(loop.id)
        stirred: dict[str, Factor] = {}
        for loop in entered:
            if loop.id in self._paths.loops:  # however it came in, and has not left again
                self._waiting.pop(loop.id, None)
                self._known.add(loop)
                if self._waiting:
                    stirred |= {
                        near.id: near for near in self._known.beside(loop) if near.id in self._waiting
                    }
        return stirred.values()

    def _turn(self, estimate: Estimate) -> Iterable[Factor]:
        """One after the other, since what has entered far away may have shown a shorter way between the ends of any of them; of
        some more those that the graph has come to expect. At the end of the input all.
        """
        if self._paths.ended:
            return [self._known[id_] for id_ in self._waiting]
        if self._entered + self._left == self._changes:
            return []
        self._changes = self._entered + self._left
        glanced = self._next(self._glances, GLANCES)
        expected = [loop for loop in glanced if self._surprise(loop, estimate) <= self._ruler.widest]
        return self._next(self._round, 1) + expected

    def _next(self, turns: list[str], count: int) -> list[Factor]:
        """Of what waits so many in turn. turns: whose comes yet, the next one last."""
        turns[:] = [id_ for id_ in turns if id_ in self._waiting] or list(self._waiting)[::-1]
        return [self._known[turns.pop()] for _ in range(min(count, len(turns)))]

    def _alone(self, loop: Factor, estimate: Estimate) -> Decision | None:
        """Why it may enter without others, if it may."""
        path = self._paths.cheapest(loop.keys)
        if path is None:
            # nothing could contradict it, and apart from it the two parts have no place to each other at all; if it is wrong,
            # the gate finds that those which it shuts out agree with each other
            return judged("witness", loop, "accepted", "joins", "the first to connect two parts", None, None)
        measured = self._paths.path_of(loop)
        found = self._ruler.compare(measured, path)
        if loop.id in self._waiting:
            self._waiting[loop.id] = found.sure
        if not found:
            return None
        if found.sure <= self._config.near:
            words = f"the graph knows to within {found.sure:.2g} m where it ends"
            return judged("witness", loop, "accepted", "near", words, found.sure, self._config.near)
        if exact := self._exact(loop, path, estimate):
            return exact
        if found.statistic <= self._lone:
            words = f"alone, and close to where {path.meters:.0f} m of odometry expect it"
            return judged("witness", loop, "accepted", "lone", words, found.statistic, self._lone)
        return None

    def _exact(self, loop: Factor, path: Path, estimate: Estimate) -> Decision | None:
        """If it falls where the way without odometry's noise, or all of the graph together, has it."""
        statistic = self._ruler.exact(self._paths.path_of(loop), path.pose, path.loops)
        who = f"after {path.meters:.0f} m odometry expects"
        if statistic > self._ruler.widest:
            statistic = self._surprise(loop, estimate)
            who = "all of the graph together expects"
        if statistic > self._ruler.widest:
            return None
        words = f"{who} it here, to within its own noise: no chance would do that"
        return judged("witness", loop, "accepted", "exact", words, statistic, self._ruler.widest)

    def _surprise(self, loop: Factor, estimate: Estimate) -> float:
        """How far the estimate is from it, in its own noise."""
        a, b = (estimate.pose(key) for key in loop.keys)
        own = self._paths.path_of(loop)
        return self._ruler.exact(own, a.between(b), 0.0 * own.loops)

    def _witnessed(self, loop: Factor) -> dict[str, Decision]:
        """A clique that is large enough: the decisions about its members that wait."""
        clique = self._clique(loop)
        if len(clique) <= self._config.others:
            return {}
        ids = sorted(member.id for member in clique)
        return {
            member.id: judged(
                "witness", member, "accepted", "clique", f"agrees with {_listed(ids, member.id)}, and these with each other",
                len(ids) - 1, self._config.others, clique=ids,
            )
            for member in clique
            if member.id in self._waiting
        }  # fmt: skip

    def _clique(self, loop: Factor) -> tuple[Factor, ...]:
        """With agreements that are sharper than what is known already: the others would agree with a false one, too."""
        return self._known.clique(loop, self._config.others + 1, self._waiting[loop.id] / SHARPER)

    def _probation(self, loop: Factor) -> Decision:
        clique = sorted(member.id for member in self._clique(loop))
        against = self._known.against(loop)
        others = len(clique) - 1
        missing = self._config.others - others
        words = f"{'no' if others == 0 else others} witness{'es' * (others > 1)}"
        words += f"; would enter with {missing} more loop{'s' * (missing > 1)} that agree with it{' and with each other' * (missing + others > 1)}"
        return judged(
            "witness", loop, "probation", "no_witness", words, others, self._config.others, clique=clique, against=against, missing=missing,
        )  # fmt: skip

    def _crowded(self) -> Iterable[Decision]:
        """The oldest of more than may wait."""
        while len(self._waiting) > self._config.held:
            loop = self._known[next(iter(self._waiting))]
            del self._waiting[loop.id]
            self._known.drop(loop.id)
            words = f"more than {self._config.held} loops wait for witnesses, and this one has waited longest"
            yield judged(
                "witness", loop, "refused", "crowded_out", words, len(self._waiting) + 1, self._config.held
            )


def _listed(ids: Iterable[str], but: str) -> str:
    return ", ".join(id_ for id_ in ids if id_ != but)
