"""Landmarks that stand still are landmarks; one that has moved, or exists twice, becomes two, and one that moves is taken out, with the reason.

What gives it away is the history of its residuals, after the solver has had its say: a pose that was off is corrected by then,
and the other landmarks seen from the same pose fit again. One that goes on not fitting where others do is looked at closely:
its sightings, drawn from the poses as they are believed now, lie at one place (the noise is larger than it says: nothing is
done), at two, one after the other (it was moved), at two in turn (there are two of that name), or anywhere (it moves).
Of two places it must be known that it is not the pose that is off (`witnesses.py`); what cannot be split (`splitting.py`) goes out.
"""

from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from .books import Books, Reason
from .graph import Decision, Delta, Estimate, Factor, Offer
from .places import TAGS, Parted, Places, misfit, parted, place_of, sigma_of, spread
from .robust.chi2 import chi2_quantile
from .robust.paths import Paths
from .robust.stage import Judged
from .sensors.landmark import PLACED
from .splitting import Splitter
from .witnesses import are_two

REMEMBERED = 30  # sightings of a landmark that are looked at
USUAL = 300  # residuals, of all landmarks, that say what is usual
TIGHT = 4.0  # standard deviations of a sighting within which nine of ten sightings of one place lie


@dataclass(slots=True, eq=False)
class History:
    """Of one landmark: its newest sightings, and whether each fitted when it came."""

    ids: deque[str] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    strange: deque[bool] = field(default_factory=lambda: deque(maxlen=REMEMBERED))


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Of a landmark that does not stand still. two: the places at which it is. apart: m between them, or around which it moves; limit: m that noise
    explains.
    """

    reason: Reason
    two: Parted | None
    apart: float
    limit: float


class Quarantine:
    """A robust stage that judges nothing on its way in, and reviews landmarks."""

    kinds: frozenset[str] = frozenset()

    def __init__(self, books: Books, splitter: Splitter, paths: Paths) -> None:
        self._config, self._space, self._factors = books.config.quarantine, books.space, books.solver.factors
        self._out, self._splitter, self._paths = books.suspended, splitter, paths
        self._histories: dict[int, History] = defaultdict(History)
        self._fresh: list[Factor] = []
        self._residuals: deque[float] = deque(maxlen=USUAL)
        self._leaving: list[int] = []  # what may have lost its last sighting
        self._parting: set[str] = set()  # sightings that have just become another landmark's

    def admit(self, proposed: Delta, estimate: Estimate) -> Judged:  # noqa: ARG002  # of no kind of factor
        return proposed, ()

    def book(self, delta: Delta) -> None:
        """What the solver has taken. What a split has moved is not judged by where the wrong name has bent the path."""
        fresh = [f for f in delta.add if f.kind == "landmark" and isinstance(f.factor, (*PLACED, *TAGS))]
        self._fresh += [f for f in fresh if f.id not in self._parting]

    def review(self, estimate: Estimate) -> Judged:
        fresh = [factor for factor in self._fresh if self._factors.get(factor.id) is factor]
        self._fresh = []
        amendment = Delta()
        decisions: list[Decision] = []
        suspects = self._noted(fresh, estimate)
        accused = self._splitter.accused(self._config.sightings)
        least = 2 * self._config.split
        ripe = [key for key in accused if 0 < least <= len(self._histories[key].ids)]
        looked_at = {key: self._verdict(key, estimate) for key in dict.fromkeys((*suspects, *ripe))}
        verdicts = {key: found for key, found in looked_at.items() if found}
        is_bent = any(found.two for found in verdicts.values())  # the path: who seems to move may stand still
        for key, found in verdicts.items():
            if (is_bent and not found.two) or self._is_early(key, found.two):
                continue
            sightings = [f for f in self._factors.values() if f.kind == "landmark" and f.keys[1] == key]
            change = self._splitter.split(key, found.two, sightings, estimate) if found.two else None
            if change is None and key in suspects:  # who is only accused by what is beside it stays
                change, told = self._taken_out(key, found, sightings)
                decisions += told
            if change is not None:
                del self._histories[key]
                amendment += change
        self._parting = {factor.id for factor in amendment.add}
        return amendment, tuple(decisions)

    def _taken_out(
        self, key: int, found: "Found", sightings: Sequence[Factor]
    ) -> tuple[Delta, list[Decision]]:
        since = found.two.since if found.two else None
        gone = [f for f in sightings if since is None or f.stamp >= since]
        self._out[key] = found.reason
        self._leaving.append(key)
        basis = {"landmark": gtsam.DefaultKeyFormatter(key), "removed": len(gone)}
        why = WHY[found.reason]
        return Delta(remove=tuple(f.id for f in gone)), [
            Decision(
                f.stamp, f.id, f.source, "removed", "quarantine", found.reason, why, found.apart, found.limit, basis=basis
            )
            for f in gone
        ]  # fmt: skip

    def left(self, known: Callable[[int], bool]) -> list[int]:
        """Those that have left the graph with their last sighting, each told once. known: whether the solver still has one."""
        gone = [key for key in self._leaving if not known(key)]
        self._leaving = []
        return gone

    # -- residuals -------------------------------------------------------------------------------

    def _noted(self, fresh: Sequence[Factor], estimate: Estimate) -> list[int]:
        """Take the residuals of new sightings down; the landmarks of which too many have not fitted, where others did."""
        if not fresh:
            return []
        residuals = [self._residual(factor, estimate) for factor in fresh]
        limit = self._limit()
        strange = [residual > limit for residual in residuals]
        by_pose: dict[int, list[bool]] = defaultdict(list)
        for factor, odd in zip(fresh, strange, strict=True):
            by_pose[factor.keys[0]].append(odd)
        suspects = []
        for factor, odd, residual in zip(fresh, strange, residuals, strict=True):
            self._residuals.append(residual)
            beside = by_pose[factor.keys[0]]
            blamed = odd and 2 * sum(beside) < len(beside)
            history = self._histories[factor.keys[1]]
            history.ids.append(factor.id)
            history.strange.append(blamed)
            if blamed and sum(history.strange) >= self._config.sightings:
                suspects.append(factor.keys[1])
        return list(dict.fromkeys(suspects))

    def _limit(self) -> float:
        """Chi-square's quantile, times the excess."""
        return chi2_quantile(self._config.probability, self._space.point_dimension) * self._excess()

    def _excess(self) -> float:
        """What residuals usually are of what they should be; at least one."""
        if len(self._residuals) < USUAL // 10:
            return 1.0
        usual = chi2_quantile(0.5, self._space.point_dimension)
        return max(1.0, float(np.median(self._residuals)) / usual)

    def _residual(self, factor: Factor, estimate: Estimate) -> float:
        return misfit(factor, estimate.value(factor.keys[1]), estimate, self._space)

    # -- places ----------------------------------------------------------------------------------

    def _verdict(self, key: int, estimate: Estimate) -> "Found | None":
        """Why it is no landmark; None where it is one after all, or where that cannot be told."""
        history = self._histories[key]
        factors = [self._factors[id_] for id_ in history.ids if id_ in self._factors]
        factors = [factor for factor in factors if factor.keys[1] == key]
        if not factors:
            return None
        factors.sort(key=lambda factor: factor.stamp)
        places = self._places(factors, estimate)
        limit = TIGHT * places.sigma
        two = parted(places, limit)
        if spread(places.points) <= limit or (two and not self._is_witnessed(two, estimate)):
            history.strange.clear()  # the noise is larger than it says, or the pose was off
            return None
        if two is None:
            return Found("moving", None, spread(places.points), limit)
        return Found("duplicate" if two.since is None else "moved", two, two.apart, limit)

    def _is_early(self, key: int, two: Parted | None) -> bool:
        """Whether there may soon be enough sightings at either place."""
        if two is None or len(self._histories[key].ids) == REMEMBERED:
            return False
        return two.fewest < self._config.split

    def _is_witnessed(self, two: Parted, estimate: Estimate) -> bool:
        def fits(factor: Factor) -> bool:
            return self._residual(factor, estimate) <= limit

        limit = self._limit()
        return are_two(two, self._paths, self._factors.values(), fits)

    def _places(self, factors: Sequence[Factor], estimate: Estimate) -> Places:
        points = np.array([place_of(factor, estimate) for factor in factors])
        sigmas = [sigma_of(factor, self._space) for factor in factors]
        return Places(factors, points, float(np.median(sigmas) * np.sqrt(self._excess())))


def let_in(
    offers: Sequence[Offer], key_of: Mapping[str, int], out: Mapping[int, Reason]
) -> tuple[list[Offer], list[Decision]]:
    """Without sightings of what is in quarantine. key_of: name of a landmark -> its key."""
    if not out:
        return list(offers), []
    inside, decisions = [], []
    for offer in offers:
        m = offer.measurement
        name = getattr(m, "landmark", "")
        reason = out.get(key_of.get(name, 0))
        if reason is None:
            inside.append(offer)
        else:
            why = f"landmark {name} is in quarantine: {reason}"
            decisions.append(Decision(m.stamp, offer.id, m.source, "refused", "landmark", "quarantined", why))
    return inside, decisions


WHY: Mapping[Reason, str] = {
    "moved": "it stands elsewhere now: its sightings since then are taken out, and further ones refused",
    "duplicate": "there are two of that name, seen in turn: all their sightings are taken out, and further ones refused",
    "moving": "it does not stand still: all its sightings are taken out, and further ones refused",
}
