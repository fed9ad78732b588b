"""Two landmarks that turn out to be one: association made the second where the pose was off, and a loop has laid it over the first.

They become one, the one that was known first, when
    both were named by one associator, and no scan has shown both: what is seen side by side is two things,
    each has been seen often enough,
    how they lie to each other is known as well as one sighting tells it: before a loop closes nothing is known of that, and
    everything would coincide,
    what lies between them may be chance: chi-square under their joint covariance,
    and no scan has shown two of all that is as close: what stands in a cluster is left alone.
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import numpy as np

from .association import Associator
from .books import Books
from .config import LandmarkSource
from .errors import SolverFailure
from .graph import Decision, Delta, Estimate, rekeyed
from .measurement import Array
from .places import sigma_of
from .robust.chi2 import chi2_quantile
from .robust.paths import Paths
from .robust.stage import Judged
from .sensors.landmark import PLACED

GROWTH = 1.25  # by which a pair's sightings grow until it is looked at again
REFRESHED = 10  # reviews after which all positions are looked up anew


@dataclass(slots=True, eq=False)
class Seen:
    """Of one landmark. scans: the stamps at which it was seen; sigma (m): of the position that its best sighting states."""

    ids: list[str]
    scans: set[int]
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two that may be one. kept: the key of the one that was known first. apart: m."""

    kept: int
    gone: int
    apart: float
    sigma: float
    statistic: float
    threshold: float


class Merger:
    """A robust stage that judges nothing on its way in, and reviews landmarks without ids."""

    kinds: frozenset[str] = frozenset()

    def __init__(
        self,
        books: Books,
        associators: Mapping[str, Associator],
        paths: Paths,
        closed: Callable[[], Collection[int]],
    ) -> None:
        """closed: variables about which others have decided something."""
        self._sources, self._space, self._factors = books.config.sources, books.space, books.solver.factors
        self._associators, self._paths, self._closed = associators, paths, closed
        self._seen: dict[int, Seen] = {}
        self._fresh: dict[int, None] = {}  # in the order of their sightings
        self._tried: dict[tuple[int, int], int] = {}  # pair -> sightings of both when it was looked at last
        self._became = books.became
        # sighting that is to move -> its landmark before, and what is told once it has
        self._moving: dict[str, tuple[int, Decision]] = {}
        self._decisions: list[Decision] = []
        self._age = REFRESHED
        self._places: dict[str, tuple[Array, Array]] = {}  # by source: keys and positions of its landmarks

    def admit(self, proposed: Delta, estimate: Estimate) -> Judged:  # noqa: ARG002  # of no kind of factor
        return proposed, ()

    def book(self, delta: Delta) -> None:
        """What the solver has taken."""
        for factor in delta.add:
            if factor.kind == "landmark" and isinstance(factor.factor, PLACED):
                key = factor.keys[1]
                sigma = sigma_of(factor, self._space)
                self._settle(factor.id, key)
                seen = self._seen.setdefault(key, Seen([], set(), sigma))
                seen.ids.append(factor.id)
                seen.scans.add(factor.stamp)
                seen.sigma = min(seen.sigma, sigma)
                self._fresh[key] = None

    def _settle(self, id_: str, key: int) -> None:
        """A sighting that was to move has moved: so has all that was known of its landmark."""
        before, decision = self._moving.pop(id_, (key, None))
        if before != key and before in self._seen and decision is not None:
            self._became[before] = key
            self._seen[key].scans |= self._seen.pop(before).scans
            self._decisions.append(decision)

    def take_decisions(self) -> list[Decision]:
        """About what the solver has taken."""
        taken, self._decisions = self._decisions, []
        return taken

    def review(self, estimate: Estimate) -> Judged:
        fresh, self._fresh = self._fresh, {}
        self._look_up(estimate)
        amendment = Delta()
        taken: set[int] = set()
        for key in self._seen if self._paths.ended else fresh:
            pair = None if key in taken else self._pair(key, taken, estimate)
            if pair is not None:
                taken |= {pair.kept, pair.gone}
                amendment += self._merged(pair)
        return amendment, ()

    # -- which -----------------------------------------------------------------------------------

    def _look_up(self, estimate: Estimate) -> None:
        """Where all landmarks are believed to be."""
        self._age += 1
        if self._age <= REFRESHED and not self._paths.ended:
            return
        self._age = 0
        keys: dict[str, list[int]] = defaultdict(list)
        for key in self._seen:
            if (source := self._source(key)) and self._is_ripe(key, source) and estimate.knows(key):
                keys[source].append(key)
        self._places = {
            source: (np.array(found), np.array([estimate.point(key) for key in found]))
            for source, found in keys.items()
        }

    def _pair(self, key: int, taken: Collection[int], estimate: Estimate) -> Pair | None:
        """With what a landmark is one; None where with nothing, or that cannot be told."""
        source = self._source(key)
        if not source or source not in self._places or not self._is_ripe(key, source):
            return None
        if not estimate.knows(key) or key in self._closed():
            return None
        settings = self._sources[source]
        assert isinstance(settings, LandmarkSource)
        limit = chi2_quantile(settings.gate, self._space.point_dimension)
        keys, points = self._places[source]
        reach = self._seen[key].sigma * float(np.sqrt(limit))
        close = np.linalg.norm(points - estimate.point(key), axis=1) <= 2 * reach
        others = [int(k) for k in keys[close].tolist() if k != key and estimate.knows(int(k))]
        gaps = {k: float(np.linalg.norm(estimate.point(k) - estimate.point(key))) for k in others}
        near = [k for k in sorted(gaps, key=lambda k: (gaps[k], k)) if gaps[k] <= reach]
        stamps = [stamp for k in (key, *near) for stamp in self._seen[k].scans]
        if not near or len(set(stamps)) < len(stamps) or near[0] in {*taken, *self._closed()}:
            return None
        return self._tested(min(key, near[0]), max(key, near[0]), limit, estimate)

    def _tested(self, kept: int, gone: int, limit: float, estimate: Estimate) -> Pair | None:
        """The two, if they may be one by all that is known of them."""
        one, other = self._seen[kept], self._seen[gone]
        count = len(one.scans) + len(other.scans)
        if count < GROWTH * self._tried.get((kept, gone), 0):
            return None
        self._tried[kept, gone] = count
        try:
            joint = estimate.covariance([kept, gone])
        except SolverFailure:
            return None
        d = self._space.point_dimension
        covariance = joint[:d, :d] + joint[d:, d:] - joint[:d, d:] - joint[d:, :d]
        gap = estimate.point(gone) - estimate.point(kept)
        statistic = float(gap @ np.linalg.solve(covariance, gap))
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        if statistic > limit or sigma > min(one.sigma, other.sigma):
            return None
        return Pair(kept, gone, float(np.linalg.norm(gap)), sigma, statistic, limit)

    def _is_ripe(self, key: int, source: str) -> bool:
        settings = self._sources[source]
        assert isinstance(settings, LandmarkSource)
        return bool(settings.merge) and len(self._seen[key].scans) >= settings.merge

    def _source(self, key: int) -> str:
        """Whose associator named it; empty for a landmark that has an id."""
        return next((name for name, each in self._associators.items() if each.name_of(key)), "")

    # -- how -------------------------------------------------------------------------------------

    def _merged(self, pair: Pair) -> Delta:
        """The sightings of the one become the other's, under their own ids."""
        moved = [self._factors[id_] for id_ in self._seen[pair.gone].ids if id_ in self._factors]
        moved = [factor for factor in moved if factor.keys[1] == pair.gone]
        source = self._source(pair.gone)
        kept, gone = (self._associators[source].name_of(key) for key in (pair.kept, pair.gone))
        change = Delta(
            tuple(rekeyed(factor, pair.gone, pair.kept) for factor in moved), tuple(f.id for f in moved)
        )
        decision = Decision(
            moved[-1].stamp, f"{source}/{gone}", source, "removed", "merging", "merged",
            f"landmark {gone} is {kept}: {pair.apart:.2g} m apart, known to {pair.sigma:.2g} m; its {len(moved)} sightings are of that now",
            pair.statistic, pair.threshold,
            basis={"into": kept, "apart": pair.apart, "sigma": pair.sigma, "sightings": [f.id for f in moved]},
        )  # fmt: skip
        self._moving |= {factor.id: (pair.gone, decision) for factor in moved}
        return change
