"""Names for sightings that come without: which landmark each is of, and when one is new."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..config import LandmarkSource
from ..context import Context, Unusable
from ..graph import Decision, Keyframe, Motion, Offer, Pose, Verdict
from ..measurement import SECOND, Array
from ..robust.chi2 import chi2_quantile
from ..sensors.landmark import NAMELESS, LandmarkObservation, as_point, moved, positioned
from ..sensors.ranging import PLACELESS
from ..space import Space
from .compatibility import Pairs, Prediction, jointly, nearest
from .consensus import consensus
from .prediction import predicted

Numbers = NDArray[np.intp]

DOUBT = 5.0  # times the stated standard deviation that a consensus may move the pose: odometry leaves out what drifts
NEW = 1 - 1e-6  # probability of chi-square beyond which a sighting is of something else
ROOM = 3.0  # standard deviations of a sighting by which a landmark may lie farther off than the closest
MOST_CANDIDATES = 24  # landmarks whose joint covariance is asked for; more only where more is seen at once
REFRESHED = 10  # scans after which all positions are looked up anew
PATIENCE = 10 * SECOND  # that a new landmark has to be seen again


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """An offer as a point from a keyframe, with its noise."""

    offer: Offer
    point: Array
    noise: Array


@dataclass(slots=True, eq=False)
class Tentative:
    """Something seen that is no landmark of the graph yet. name: once it is to be one, at the end of this window."""

    pose: int
    keyframe: int  # its stamp
    sightings: list[Sighting] = field(default_factory=list)
    name: str = ""

    @property
    def newest(self) -> int:
        return self.sightings[-1].offer.measurement.stamp


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Sightings of one moment, from one keyframe."""

    keyframe: Keyframe
    pose: Pose  # predicted
    sightings: list[Sighting]

    @property
    def points(self) -> Array:
        return np.array([each.point for each in self.sightings])

    @property
    def noises(self) -> Array:
        return np.array([each.noise for each in self.sightings])


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """Landmarks around the scans of a keyframe, by their numbers.

    near: (N,) in reach of a consensus. candidates: (K,) close to a sighting; points: (K, d) where they should be seen from the
    keyframe, covariance: (K d, K d) joint, of that.
    """

    near: Numbers
    candidates: Numbers
    points: Array
    covariance: Array

    @property
    def sigma(self) -> float:
        """The largest of any candidate's place (m); infinite without candidates."""
        if not len(self.candidates):
            return np.inf
        return float(np.sqrt(np.diag(self.covariance).max()))


class Associator:
    """Of one source. The joint covariance of the newest pose and the landmarks around it is the solver's own, carried to
    the new keyframe by the odometry; so what is certain after a loop is certain here.
    """

    def __init__(self, source: str, config: LandmarkSource, space: Space) -> None:
        self._source, self._config, self._space = source, config, space
        self._names: list[str] = []
        self._keys: list[int] = []
        self._by_key: dict[int, str] = {}
        self._points = np.zeros((0, space.point_dimension))
        self._age = 0
        self._made = 0
        self._tentative: list[Tentative] = []
        self._accused: dict[int, float] = defaultdict(float)

    def restore(self, landmarks: Mapping[str, int]) -> None:
        """Go on with those of a saved map. landmarks: name -> key."""
        self._names = [name for name in landmarks if self._is_own(name)]
        self._keys = [landmarks[name] for name in self._names]
        self._by_key = dict(zip(self._keys, self._names, strict=True))
        self._made = max((int(name.rpartition(":")[2]) + 1 for name in self._names), default=0)
        self._points = np.full((len(self._keys), self._space.point_dimension), np.inf)
        self._age = REFRESHED

    def name_of(self, key: int) -> str | None:
        """Of a landmark that it has named; None of any other."""
        return self._by_key.get(key)

    def accused(self, often: int) -> list[int]:
        """Landmarks that may be two, by their keys, each told once: so many sightings were too close to be of anything else, and not of
        it, or something new began beside it.
        """
        found = [key for key, count in self._accused.items() if count >= often]
        for key in found:
            del self._accused[key]
        return found

    def named(
        self, offers: Sequence[Offer], a: Keyframe | None, b: Keyframe, context: Context
    ) -> tuple[list[Offer], list[Decision]]:
        """The offers whose landmark is known by now, by their names, those of earlier keyframes among them; and why."""
        self._tentative = [each for each in self._tentative if not each.name]
        named: list[Offer] = []
        decisions: list[Decision] = []
        scans: dict[tuple[int, str], list[Offer]] = defaultdict(list)
        for offer in offers:
            m = offer.measurement
            assert isinstance(m, LandmarkObservation)
            if m.landmark == NAMELESS or (self._config.ignore_ids and not self._is_own(m.landmark)):
                scans[m.stamp, m.frame].append(offer._replace(measurement=positioned(m)))
            else:
                named.append(offer)
        regions: dict[int, list[Scan]] = defaultdict(list)
        for scan in scans.values():
            try:
                found = self._scan(scan, context)
            except Unusable as why:
                decisions += [self._told(each, "refused", why.reason, why.detail) for each in scan]
                continue
            regions[found.keyframe.pose].append(found)
        for beside in regions.values():
            region = self._region(beside, a, context)
            for each in beside:
                self._associate(each, region, context, named, decisions)
        decisions += self._impatient(b.stamp)
        return named, decisions

    def _scan(self, offers: Sequence[Offer], context: Context) -> Scan:
        first = offers[0].measurement
        assert isinstance(first, LandmarkObservation)
        placed, mount = context.landing(first.stamp), context.mount(first.frame)
        sightings = []
        for offer in offers:
            m = offer.measurement
            assert isinstance(m, LandmarkObservation)
            if m.form in PLACELESS:
                raise Unusable("nameless", f"a {m.form} alone cannot be associated: give it an id")
            point, noise = as_point(m, mount, placed.motion, context, self._config)
            sightings.append(Sighting(offer, point, noise))
        return Scan(placed.keyframe, context.pose(placed.keyframe.pose), sightings)

    def _associate(
        self, scan: Scan, region: "Region", context: Context, named: list[Offer], decisions: list[Decision]
    ) -> None:
        pairs, distances = self._matched(scan, region)
        reason, names = "matched", [self._names[n] for n in region.candidates.tolist()]
        if 2 * len(pairs) < len(scan.sightings) and (agreed := self._agreed(scan, region)):
            pairs, reason, names = agreed, "consensus", [self._names[n] for n in region.near.tolist()]
            self._age = REFRESHED
        threshold, strange = (chi2_quantile(p, self._space.point_dimension) for p in (self._config.gate, NEW))
        told = partial(self._told, threshold=threshold)
        tentative = self._placed_tentative(context)
        for n, sighting in enumerate(scan.sightings):
            offer, closest = sighting.offer, float(distances[n].min(initial=np.inf))
            if n in pairs:
                name = names[pairs[n]]
                statistic = float(distances[n, pairs[n]]) if reason == "matched" else None
                named.append(renamed(offer, name))
                decisions.append(told(offer, "accepted", reason, f"of {name}", statistic))
            elif reason == "matched" and closest <= strange:
                why = "too close to a landmark to be new, and not of it"
                decisions.append(told(offer, "refused", "ambiguous", why, closest))
                self._accused[self._closest(region, distances[n])] += 1
            elif self._wait(scan, sighting, tentative, context, named, decisions) and closest < np.inf:
                self._accused[self._closest(region, distances[n])] = np.inf

    def _closest(self, region: "Region", distances: Array) -> int:
        return self._keys[int(region.candidates[distances.argmin()])]

    # -- landmarks that exist --------------------------------------------------------------------

    def _region(self, scans: Sequence[Scan], a: Keyframe | None, context: Context) -> "Region":
        """What lies around the scans of one keyframe."""
        pose, keyframe = scans[0].pose, scans[0].keyframe
        seen = np.array([pose.transformFrom(point) for scan in scans for point in scan.points])
        near = self._near(keyframe, seen, np.asarray(pose.translation()), context)
        gaps = np.linalg.norm(seen[:, None] - self._points[near][None], axis=2)
        rows = np.unique(np.nonzero(self._plausible(gaps, scans))[1])
        order = np.argsort(gaps[:, rows].min(axis=0, initial=np.inf), kind="stable")
        most = max(MOST_CANDIDATES, *(len(scan.sightings) for scan in scans))
        rows = np.sort(rows[order][:most])
        candidates = near[rows]
        keys = [self._keys[n] for n in candidates.tolist()]
        points, covariance = predicted(keyframe, keys, self._points[candidates], a, context)
        return Region(near, candidates, points, covariance)

    def _plausible(self, gaps: Array, scans: Sequence[Scan]) -> NDArray[np.bool_]:
        """(n, K) which landmarks a sighting may be of: the closest, and those that noise could make the closest."""
        sigmas = np.sqrt(np.concatenate([np.trace(s.noises, axis1=1, axis2=2) for s in scans]))
        limit = gaps.min(axis=1, initial=np.inf) + ROOM * sigmas
        return np.asarray(gaps <= np.minimum(limit, self._config.search)[:, None])

    def _near(self, keyframe: Keyframe, seen: Array, here: Array, context: Context) -> Numbers:
        """Numbers of the landmarks in reach of what is seen, in the same part of the graph."""
        self._age += 1
        part = context.component(keyframe.pose)
        if self._age > REFRESHED:
            self._look_up(np.arange(len(self._keys)), context)
            self._age = 0
        reach = float(np.linalg.norm(seen - here, axis=1).max()) + self._config.search
        near = np.flatnonzero(np.linalg.norm(self._points - here, axis=1) <= reach)
        near = np.array([n for n in near.tolist() if context.component(self._keys[n]) == part], dtype=np.intp)
        self._look_up(near, context)
        return near

    def _look_up(self, which: Numbers, context: Context) -> None:
        for n in which.tolist():
            if context.component(self._keys[n]) is not None:
                self._points[n] = context.point(self._keys[n])

    def _matched(self, scan: Scan, region: "Region") -> tuple[Pairs, Array]:
        """Pairs of sightings and candidates, and all squared distances."""
        prediction = Prediction(scan.points[:, None] - region.points[None], scan.noises, region.covariance)
        if not len(region.candidates):
            return {}, np.zeros((len(scan.sightings), 0))
        distances = prediction.distances()
        if self._config.association == "nearest":
            limit = chi2_quantile(self._config.gate, self._space.point_dimension)
            return nearest(distances, limit), distances
        return jointly(prediction, distances, self._config.gate), distances

    def _agreed(self, scan: Scan, region: "Region") -> Pairs | None:
        """Pairs by consensus, where the prediction is too far off for the gate."""
        if self._config.search == 0:
            return None
        here = np.asarray(scan.pose.translation())
        seen = np.array([scan.pose.transformFrom(point) for point in scan.points]) - here
        sigma = np.sqrt(np.trace(scan.noises, axis1=1, axis2=2).max())
        tolerance = 2.0 * float(sigma)
        reach = min(self._config.search, tolerance + DOUBT * region.sigma)
        found = consensus(seen, self._points[region.near] - here, tolerance, reach)
        return found.pairs if found else None

    # -- landmarks to be -------------------------------------------------------------------------

    def _placed_tentative(self, context: Context) -> "Array":
        """(N, d) where the first sightings of what is tentative put it."""
        points = [context.pose(each.pose).transformFrom(each.sightings[0].point) for each in self._tentative]
        return np.array(points).reshape(-1, self._space.point_dimension)

    def _wait(
        self, scan: Scan, sighting: Sighting, places: Array, context: Context,
        named: list[Offer], decisions: list[Decision],
    ) -> bool:  # fmt: skip
        """One more sighting of something new; enough of them make a landmark: whether they do. places: of what is tentative already."""
        tentative = self._fitting(scan, sighting, places, context)
        if tentative is None:
            self._tentative.append(Tentative(scan.keyframe.pose, scan.keyframe.stamp, [sighting]))
            tentative = self._tentative[-1]
        else:
            tentative.sightings.append(sighting)
        if len(tentative.sightings) < self._config.confirmations:
            return False
        ready, begins = tentative.sightings[-1:], not tentative.name
        if begins:
            tentative.name, ready = self.begin(context.landmark), tentative.sightings
        for each in ready:
            named.append(renamed(each.offer, tentative.name))
            decisions.append(self._told(each.offer, "accepted", "new", f"of {tentative.name}, which is new"))
        return begins

    def begin(self, landmark: Callable[[str], int]) -> str:
        """The name of a new landmark, which will be in the graph soon. landmark: name -> key."""
        name = f"{self._source}:{self._made}"
        self._made += 1
        self._names.append(name)
        self._keys.append(key := landmark(name))
        self._by_key[key] = name
        self._points = np.vstack([self._points, np.full(self._space.point_dimension, np.inf)])
        self._age = REFRESHED
        return name

    def _fitting(self, scan: Scan, sighting: Sighting, places: Array, context: Context) -> Tentative | None:
        """The closest that may be the same: seen lately, so the odometry since says how they lie."""
        best, closest = None, chi2_quantile(self._config.gate, self._space.point_dimension)
        seen = scan.pose.transformFrom(sighting.point)
        for n in np.flatnonzero(np.linalg.norm(places - seen, axis=1) <= self._config.search).tolist():
            each = self._tentative[n]
            if each.newest == sighting.offer.measurement.stamp:
                continue
            first, error = each.sightings[0], sighting.point - scan.pose.transformTo(places[n])
            motion = None if each.pose == scan.keyframe.pose else self._between(each, scan, context)
            _, noise = moved(first.point, first.noise, self._space.identity, motion)
            distance = float(error @ np.linalg.solve(noise + sighting.noise, error))
            if distance < closest:
                best, closest = each, distance
        return best

    def _between(self, each: Tentative, scan: Scan, context: Context) -> Motion:
        return context.motion(scan.keyframe.stamp, each.keyframe)

    def _impatient(self, now: int) -> list[Decision]:
        gone = [each for each in self._tentative if each.newest < now - PATIENCE]
        self._tentative = [each for each in self._tentative if each.newest >= now - PATIENCE]
        return [
            self._told(s.offer, "refused", "unconfirmed", "not seen again")
            for each in gone
            for s in each.sightings
        ]

    def _is_own(self, name: str) -> bool:
        return name.startswith(f"{self._source}:")

    def _told(
        self, offer: Offer, verdict: Verdict, reason: str, detail: str,
        statistic: float | None = None, threshold: float | None = None,
    ) -> Decision:  # fmt: skip
        m = offer.measurement
        return Decision(
            m.stamp, offer.id, m.source, verdict, "association", reason, detail, statistic,
            None if statistic is None else threshold,
        )  # fmt: skip


def renamed(offer: Offer, name: str) -> Offer:
    assert isinstance(offer.measurement, LandmarkObservation)
    return offer._replace(measurement=replace(offer.measurement, landmark=name))
