"""The gate: chi-square of a loop against the cheapest path between its ends, through odometry and accepted loops.

The further the odometry has run, the wider the gate: drift widens it. It is scaled, because stated covariances leave out
bias and correlation in time, and bounded by the length of the path, because others state far too much.

A loop that only accepted loops contradict, and not odometry, says either that it is wrong or that they are. The smallest set
of them whose absence would let it pass is part of its verdict; when more than twice as many loops as that set holds agree with
each other and were refused for its sake, it is the set that goes.
"""

from collections.abc import Iterable
from math import isfinite
from typing import Any

from ..config import Config
from ..graph import Decision, Delta, Estimate, Factor
from .accord import Accord, Ruler, told
from .held import Held
from .paths import Path, Paths
from .stage import Judged, judged

TRIALS = 8  # ways that a search for the smallest set of contradicting loops may look at
STIRRED = 6  # nearest refused loops that are judged anew where something has changed
VOTERS = 6  # nearest accepted loops that are asked about a new one
OUTVOTE = 2  # loops in favour, for each one against


class Gate:
    kinds = frozenset({"loop"})

    def __init__(self, config: Config, paths: Paths) -> None:
        self._paths, self._drift = paths, config.gate.drift
        self._others, self._room = config.witness.others, config.witness.held
        self._ruler = Ruler(paths.space, config.gate, paths.usual, config.witness.near)
        self._statistics: dict[str, float] = {}  # of what was let through, until it is in the graph
        self._refused = Held(paths, config)
        self._contested = Held(paths, config)  # those of them that odometry does not contradict
        self._culprits: dict[
            str, frozenset[str]
        ] = {}  # of the contested: accepted loops without which they would pass
        self._fresh: list[Factor] = []  # contested since the last review
        self._inside = Held(paths, config)  # in the graph
        self._given_up: set[str] = set()
        self._suspects: dict[str, Factor] = {}  # in the graph, where something has changed
        self._entered = self._left = 0  # of what came into the graph, and went

    def admit(self, proposed: Delta, estimate: Estimate) -> Judged:  # noqa: ARG002  # odometry and loops say enough
        kept, decisions = [], []
        for loop in proposed.add:
            decision = self._judged(loop)
            if decision.verdict == "accepted":
                kept.append(loop)
                if decision.statistic is not None:
                    self._statistics[loop.id] = decision.statistic
            decisions.append(decision)
        return Delta(tuple(kept), proposed.remove, proposed.values), tuple(decisions)

    def review(self, estimate: Estimate) -> Judged:  # noqa: ARG002
        """The worst loop that the graph cannot bear goes; refused ones beside what has changed are judged anew, and what they
        outvote is taken out.
        """
        stirred = self._stirred()
        if worst := self._worst():
            return Delta(remove=(worst.id,)), (worst,)
        add: list[Factor] = []
        decisions: list[Decision] = []
        for loop in stirred:
            if loop.id not in self._refused:
                continue
            path = self._paths.cheapest(loop.keys)
            if path is None or (found := self._ruler.compare(self._paths.path_of(loop), path)):
                self._forget(loop.id)
                add.append(loop)
                decisions.append(_passed(loop, found, path) if path else _unconnected(loop))
        fresh, self._fresh = self._fresh, []
        for loop in fresh:
            if loop.id in self._contested and (winners := self._winners(loop)):
                losers = self._deposed(winners)
                for each in winners:
                    self._forget(each.id)
                told_of = (*_outvoted(losers, winners), *_winning(winners, losers))
                return Delta((*add, *winners), tuple(each.id for each in losers)), (*decisions, *told_of)
        return Delta(tuple(add)), tuple(decisions)

    def _worst(self) -> Decision | None:
        """Of the suspects, the one that most loops around it contradict; None if they are outweighed by those that agree."""
        votes = {id_: self._votes(loop) for id_, loop in self._suspects.items()}
        worst = max(votes, key=lambda id_: len(votes[id_][1]) - OUTVOTE * len(votes[id_][0]), default=None)
        if worst is None or len(votes[worst][1]) <= OUTVOTE * (len(votes[worst][0]) + 1):
            self._suspects.clear()
            return None
        loop, (agree, against) = self._suspects.pop(worst), votes[worst]
        self._given_up.add(worst)
        words = f"{len(against)} accepted loops around it contradict it, and {len(agree)} agree"
        basis = {"against": against, "agree": agree}
        return judged(
            "gate", loop, "removed", "contradicted", words, len(against), OUTVOTE * (len(agree) + 1), **basis
        )

    def _votes(self, loop: Factor) -> tuple[list[str], list[str]]:
        """Ids of accepted loops nearby that agree with it, and that contradict it."""
        found = [(near.id, self._inside.agree(loop, near)) for near in self._inside.beside(loop)[:VOTERS]]
        limit = self._ruler.threshold
        sides: tuple[list[str], list[str]] = ([], [])
        for id_, accord in found:
            if accord is not None:
                sides[not (accord.possible and accord.statistic <= limit)].append(id_)
        return sides

    def _judged(self, loop: Factor) -> Decision:
        path = self._paths.cheapest(loop.keys)
        if path is None:
            return _unconnected(loop)
        found = self._ruler.compare(self._paths.path_of(loop), path)
        if found:
            return _passed(loop, found, path)
        self._refused.add(loop)
        culprits = self._smallest(loop, path) if isfinite(found.statistic) else None
        if culprits:
            self._contested.add(loop)
            self._culprits[loop.id] = culprits
            self._fresh.append(loop)
        while len(self._refused) > self._room:
            self._forget(self._refused.oldest.id)
        return self._refusal(loop, found, path, culprits)

    def _refusal(self, loop: Factor, found: Accord, path: Path, culprits: frozenset[str] | None) -> Decision:
        if not isfinite(found.statistic):
            words = "its numbers are too large or too small to be compared with anything"
            return judged("gate", loop, "refused", "incomparable", words, None, None)
        noise, drift = self._ruler.remedy(self._paths.path_of(loop), path)
        remedy, words = told(noise, drift, self._drift)
        basis = {**_basis(found, path), "would_pass": remedy}
        if culprits:
            basis["absent"] = sorted(culprits)
            words += f", or without {_listed(culprits)}"
        reason, statistic, threshold = "distance", found.statistic, found.threshold
        if found.likely:
            reason, statistic, threshold = "drift", found.away[0], found.bound[0]
            if statistic <= threshold:
                statistic, threshold = found.away[1], found.bound[1]
        return judged(
            "gate", loop, "refused", reason, f"{_where(found, path)}; {words}", statistic, threshold, **basis
        )

    def _smallest(self, loop: Factor, path: Path) -> frozenset[str] | None:
        """The smallest set of accepted loops without which it would pass; None if there is none, or the search is too long.

        Such a set takes at least one loop from every way that contradicts it: those of growing size are tried in turn.
        """
        if not path.via or (
            (alone := self._paths.along(loop.keys[0], loop.keys[1])) and not self._passes(loop, alone)
        ):
            return None
        failing = [(frozenset[str](), path)]
        trials = 0
        while failing:
            tried = {}
            for gone, contradicting in failing:
                for id_ in contradicting.via:
                    without = gone | {id_}
                    if without in tried:
                        continue
                    if (trials := trials + 1) > TRIALS:
                        return None
                    way = self._paths.cheapest(loop.keys, without)
                    if way is None or self._passes(loop, way):
                        return without
                    tried[without] = way
            failing = list(tried.items())
        return None

    def _passes(self, loop: Factor, path: Path) -> bool:
        return bool(self._ruler.compare(self._paths.path_of(loop), path))

    def _winners(self, loop: Factor) -> tuple[Factor, ...]:
        """Contested loops that agree with it and each other, and are more than OUTVOTE times those in their way; else none."""
        size = max(self._others + 1, OUTVOTE * len(self._culprits[loop.id]) + 1)
        clique = self._contested.clique(loop, size)
        standing = [id_ for each in clique for id_ in self._culprits[each.id] if id_ not in self._paths.loops]
        if standing or len(clique) < size or len(clique) <= OUTVOTE * len(self._deposed(clique)):
            return ()
        return clique

    def _deposed(self, winners: Iterable[Factor]) -> tuple[Factor, ...]:
        ids = frozenset[str]().union(*(self._culprits[each.id] for each in winners))
        return tuple(self._paths.factors[id_] for id_ in sorted(ids))

    def _stirred(self) -> Iterable[Factor]:
        """Refused loops beside one that has come into the graph and agrees with them, or has gone, since the last review."""
        entered, left = self._paths.entered[self._entered :], self._paths.left[self._left :]
        self._entered, self._left = len(self._paths.entered), len(self._paths.left)
        for loop in entered:
            if loop.id in self._paths.loops:
                self._forget(loop.id)  # it is in, by whatever way
                self._inside.add(loop)
                if (statistic := self._statistics.pop(loop.id, None)) is not None:
                    self._ruler.usual.add(statistic)
                if against := self._votes(loop)[1]:
                    self._suspects |= {id_: self._inside[id_] for id_ in (loop.id, *against)}
        for loop in left:
            if loop.id not in self._paths.loops:
                self._inside.drop(loop.id)
                self._suspects.pop(loop.id, None)
                if loop.id not in self._given_up:
                    self._refused.add(loop)
        stirred: dict[str, Factor] = {}
        for loop, is_in in [(loop, True) for loop in entered] + [(loop, False) for loop in left]:
            for near in self._refused.beside(loop)[:STIRRED]:
                if not is_in or self._speaks_for(loop, near):
                    stirred[near.id] = near
        return stirred.values()

    def _speaks_for(self, loop: Factor, refused: Factor) -> bool:
        """Whether the way over an accepted loop leads to where a refused one ends, or cannot tell."""
        accord = self._refused.accord(refused, loop)
        return accord is None or (accord.possible and accord.statistic <= self._ruler.threshold)

    def _forget(self, id_: str) -> None:
        self._refused.drop(id_)
        self._contested.drop(id_)
        self._culprits.pop(id_, None)


def _where(found: Accord, path: Path) -> str:
    by = f" and {len(path.via)} loop{'s' * (len(path.via) > 1)}" if path.via else ""
    return f"{found.away[0]:.3g} m and {found.away[1]:.3g} rad from where {path.meters:.3g} m of odometry{by} expect it"


def _basis(found: Accord, path: Path) -> dict[str, Any]:
    return {
        "distance": found.statistic,
        "limit": found.threshold,
        "away_m": found.away[0],
        "away_rad": found.away[1],
        "sure_m": found.sure,
        "path_m": path.meters,
        "via": list(path.via),
    }


def _passed(loop: Factor, found: Accord, path: Path) -> Decision:
    words = _where(found, path)
    return judged(
        "gate", loop, "accepted", "passes", words, found.statistic, found.threshold, **_basis(found, path)
    )


def _unconnected(loop: Factor) -> Decision:
    words = "neither odometry nor loops connect its ends: there is nothing that it could contradict"
    return judged("gate", loop, "accepted", "unconnected", words, None, None)


def _outvoted(losers: Iterable[Factor], winners: tuple[Factor, ...]) -> Iterable[Decision]:
    losers = tuple(losers)
    ids = sorted(each.id for each in winners)
    words = f"{len(ids)} loops agree with each other and would pass but for {len(losers)} with this one: {_listed(ids)}"
    for loop in losers:
        yield judged("gate", loop, "removed", "outvoted", words, len(ids), OUTVOTE * len(losers), by=ids)


def _winning(winners: tuple[Factor, ...], losers: tuple[Factor, ...]) -> Iterable[Decision]:
    ids = sorted(each.id for each in losers)
    for loop in winners:
        words = f"with {len(winners) - 1} others it outvotes {_listed(ids)}"
        yield judged(
            "gate", loop, "accepted", "outvotes", words, len(winners), OUTVOTE * len(losers), removed=ids
        )


def _listed(ids: Iterable[str]) -> str:
    """The first few."""
    ids = sorted(ids)
    return ", ".join(ids[:3]) + (f" and {len(ids) - 3} more" if len(ids) > 3 else "")
