"""Landmarks that stand still are landmarks; one that has moved, moves, or exists twice is taken out, with the reason.

What gives it away is the history of its residuals, after the solver has had its say: a pose that was off is corrected by then,
and the other landmarks seen from the same pose fit again. One that goes on not fitting where others do is looked at closely:
its sightings, drawn from the poses as they are believed now, lie at one place (the noise is larger than it says: nothing is
done), at two, one after the other (it was moved), at two in turn (there are two of that name), or anywhere (it moves).
"""

from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import gtsam
import numpy as np

from .config import Config
from .graph import Decision, Delta, Estimate, Factor, Offer
from .places import TAGS, Places, apart_by, halves, parted_in_time, place_of, sigma_of, spread
from .robust.chi2 import chi2_quantile
from .robust.kernels import without_kernel
from .robust.stage import Judged
from .sensors.landmark import PLACED
from .space import Space

Reason = Literal["moved", "duplicate", "moving"]

REMEMBERED = 30  # sightings of a landmark that are looked at
USUAL = 300  # residuals, of all landmarks, that say what is usual
TIGHT = 4.0  # standard deviations of a sighting within which nine of ten sightings of one place lie


@dataclass(slots=True, eq=False)
class History:
    """Of one landmark: its newest sightings, and whether each fitted when it came."""

    ids: deque[str] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    strange: deque[bool] = field(default_factory=lambda: deque(maxlen=REMEMBERED))


class Quarantine:
    """A robust stage that judges nothing on its way in, and reviews landmarks."""

    kinds: frozenset[str] = frozenset()

    def __init__(self, config: Config, space: Space, factors: Mapping[str, Factor]) -> None:
        """factors: all that are in the graph, by their ids."""
        self._config, self._space, self._factors = config.quarantine, space, factors
        self._histories: dict[int, History] = defaultdict(History)
        self._fresh: list[Factor] = []
        self._residuals: deque[float] = deque(maxlen=USUAL)
        self._out: dict[int, Reason] = {}
        self._leaving: list[int] = []  # what may have lost its last sighting

    def admit(self, proposed: Delta, estimate: Estimate) -> Judged:  # noqa: ARG002  # of no kind of factor
        return proposed, ()

    def book(self, delta: Delta) -> None:
        """What the solver has taken."""
        self._fresh += [
            f for f in delta.add if f.kind == "landmark" and isinstance(f.factor, (*PLACED, *TAGS))
        ]

    def let_in(
        self, offers: Sequence[Offer], key_of: Mapping[str, int]
    ) -> tuple[list[Offer], list[Decision]]:
        """Without sightings of what is in quarantine. key_of: name of a landmark -> its key."""
        if not self._out:
            return list(offers), []
        inside, decisions = [], []
        for offer in offers:
            m = offer.measurement
            name = getattr(m, "landmark", "")
            reason = self._out.get(key_of.get(name, 0))
            if reason is None:
                inside.append(offer)
            else:
                why = f"landmark {name} is in quarantine: {reason}"
                decisions.append(
                    Decision(m.stamp, offer.id, m.source, "refused", "landmark", "quarantined", why)
                )
        return inside, decisions

    def review(self, estimate: Estimate) -> Judged:
        fresh = [factor for factor in self._fresh if factor.id in self._factors]
        self._fresh = []
        suspects = self._noted(fresh, estimate)
        remove: list[str] = []
        decisions: list[Decision] = []
        for key in suspects:
            if (verdict := self._verdict(key, estimate)) is None:
                continue
            reason, gone, statistic, threshold = verdict
            self._out[key] = reason
            self._leaving.append(key)
            del self._histories[key]
            remove += [factor.id for factor in gone]
            decisions += [
                Decision(
                    f.stamp, f.id, f.source, "removed", "quarantine", reason, WHY[reason], statistic, threshold,
                    basis={"landmark": gtsam.DefaultKeyFormatter(key), "removed": len(gone)},
                )
                for f in gone
            ]  # fmt: skip
        return Delta(remove=tuple(remove)), tuple(decisions)

    @property
    def suspected(self) -> set[int]:
        """Landmarks that are in quarantine."""
        return set(self._out)

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
        """Chi-square; of a tag that of its position alone."""
        values = gtsam.Values()
        for key in factor.keys:
            values.insert(key, estimate.value(key))
        noise: Any = without_kernel(factor.factor.noiseModel())
        if isinstance(factor.factor, TAGS):
            place = self._space.translation
            off = factor.factor.unwhitenedError(values)[place]
            return float(off @ np.linalg.solve(noise.covariance()[place, place], off))
        white = noise.whiten(factor.factor.unwhitenedError(values))
        return float(white @ white)

    # -- places ----------------------------------------------------------------------------------

    def _verdict(self, key: int, estimate: Estimate) -> tuple[Reason, Sequence[Factor], float, float] | None:
        """Why it is no landmark, which sightings go, how far apart its places are (m), and how far they may be."""
        history = self._histories[key]
        factors = [self._factors[id_] for id_ in history.ids if id_ in self._factors]
        factors.sort(key=lambda factor: factor.stamp)
        places = self._places(factors, estimate)
        limit = TIGHT * places.sigma
        if spread(places.points) <= limit:
            history.strange.clear()  # one place after all: the noise is larger than it says
            return None
        every = [f for f in self._factors.values() if f.kind == "landmark" and f.keys[1] == key]
        then = parted_in_time(places.points)
        if then is not None and (apart := apart_by(places.points[:then], places.points[then:], limit)):
            since = places.factors[then].stamp
            return "moved", [f for f in every if f.stamp >= since], apart, limit
        one = halves(places.points)
        if apart := apart_by(places.points[one], places.points[~one], limit):
            return "duplicate", every, apart, limit
        return "moving", every, spread(places.points), limit

    def _places(self, factors: Sequence[Factor], estimate: Estimate) -> Places:
        points = np.array([place_of(factor, estimate) for factor in factors])
        sigmas = [sigma_of(factor, self._space) for factor in factors]
        return Places(factors, points, float(np.median(sigmas) * np.sqrt(self._excess())))


WHY: Mapping[Reason, str] = {
    "moved": "it stands elsewhere now: its sightings since then are taken out, and further ones refused",
    "duplicate": "there are two of that name, seen in turn: all their sightings are taken out, and further ones refused",
    "moving": "it does not stand still: all its sightings are taken out, and further ones refused",
}
