"""One landmark whose sightings lie clearly at two places becomes two, and every sighting goes on to count, at its own place.

What an associator has named becomes two of its landmarks, and later sightings are associated with both. A landmark with an id of the sender was
moved once, or there are two that bear the number: the second place to be seen is called `<id>~2`, and later sightings of the id are sorted by
where they are: see `at_their_places`. It stays one, and goes into quarantine as a whole, where

    either place has too few sightings,
    it has been split before: what is at a third place is not known to stand still anywhere,
    a person has decided something about one of its sightings: it could not be put back where it was.

What has been split is not merged again: the merger goes on to know the scans of the whole.
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .association import Associator
from .association.associator import renamed
from .association.compatibility import Prediction, nearest
from .association.prediction import predicted
from .books import SECOND_PLACE, Books, Twins
from .config import LandmarkSource
from .context import Context, Unusable
from .graph import Decision, Delta, Estimate, Factor, Keyframe, Offer, Verdict, rekeyed
from .measurement import Array
from .places import TAGS, Parted, misfit
from .robust.chi2 import chi2_quantile
from .sensors.landmark import LandmarkObservation, as_point, level, positioned
from .sensors.ranging import PLACELESS
from .variables import is_posed


class Planned(NamedTuple):
    """A split on its way into the graph. twins: of which id; None where an associator will tell the two apart."""

    decision: Decision
    name: str
    twins: Twins | None


class Splitter:
    def __init__(
        self, books: Books, associators: Mapping[str, Associator], closed: Callable[[], Collection[int]]
    ) -> None:
        """closed: variables about which a person has decided something."""
        self._books, self._space, self._associators, self._closed = books, books.space, associators, closed
        self._least = books.config.quarantine.split
        self._planned: dict[int, Planned] = {}  # by the key of the new landmark

    def accused(self, often: int) -> list[int]:
        """Landmarks of associators that may be two, by what was seen beside them."""
        return [key for each in self._associators.values() for key in each.accused(often)]

    def split(self, key: int, two: Parted, sightings: Sequence[Factor], estimate: Estimate) -> Delta | None:
        """The sightings at the second place become those of a new landmark, under their own ids. sightings: all of it. None: it stays one."""
        name = next(name for name, each in self._books.landmarks.items() if each == key)
        associator = next((each for each in self._associators.values() if each.name_of(key)), None)
        since = two.since if associator is None else None  # an associator's landmarks do not move
        places = [self._guess(two, which, estimate) for which in (two.first, ~two.first)]
        leaving = self._leaving(sightings, places, since, estimate)
        staying = len(sightings) - len(leaving)
        if not self._least or min(staying, len(leaving)) < self._least or key in self._closed():
            return None
        if associator is None and self._is_split(name):
            return None
        new = name + SECOND_PLACE if associator is None else associator.begin(self._books.landmark)
        landmark = self._books.tag(new) if is_posed(key) else self._books.landmark(new)
        twins = None if associator else Twins((name, new), since)
        reason = "confused" if associator else "duplicate" if since is None else "moved"
        self._planned[landmark] = Planned(_announced(reason, (name, new), two, leaving, staying), name, twins)
        moved = tuple(rekeyed(factor, key, landmark) for factor in leaving)
        return Delta(moved, tuple(factor.id for factor in leaving), {landmark: places[1]})

    def book(self, delta: Delta) -> list[Decision]:
        """What the solver has taken; the splits among that are told."""
        if not self._planned:
            return []
        taken = {factor.keys[1]: None for factor in delta.add if factor.kind == "landmark"}
        done = [planned for key in taken if (planned := self._planned.pop(key, None))]
        self._books.twins |= {planned.name: planned.twins for planned in done if planned.twins}
        return [planned.decision for planned in done]

    def _is_split(self, name: str) -> bool:
        return name + SECOND_PLACE in self._books.landmarks or name.endswith(SECOND_PLACE)

    def _guess(self, two: Parted, which: NDArray[np.bool_], estimate: Estimate) -> Any:
        """Where these sightings put it: their median; of a tag what the one closest to that says."""
        points = two.places.points[which]
        middle = np.median(points, axis=0)
        factors = [factor for factor, its in zip(two.places.factors, which, strict=True) if its]
        closest = factors[int(np.argmin(np.linalg.norm(points - middle, axis=1)))]
        if isinstance(closest.factor, TAGS):
            return estimate.pose(closest.keys[0]).compose(closest.factor.measured())
        return middle

    def _leaving(
        self, sightings: Sequence[Factor], places: Sequence[Any], since: int | None, estimate: Estimate
    ) -> list[Factor]:
        """Those of the second place: what has been seen since it was moved, or fits better there. The earliest of all stays."""
        if since is not None:
            return [factor for factor in sightings if factor.stamp >= since]
        gaps = [[misfit(f, place, estimate, self._space) for place in places] for f in sightings]
        second = np.array([at_one > at_other for at_one, at_other in gaps])
        second ^= second[min(range(len(sightings)), key=lambda n: sightings[n].stamp)]
        return [factor for factor, leaves in zip(sightings, second, strict=True) if leaves]


def _announced(
    reason: str, names: tuple[str, str], two: Parted, leaving: Sequence[Factor], staying: int
) -> Decision:
    """The decision about the new landmark."""
    (name, new), source, spreads = names, leaving[-1].source, two.spreads
    why = (
        f"{name} is at two places, {two.apart:.2g} m apart, each known to {max(spreads):.2g} m: {len(leaving)} sightings are of {new} now, "
        f"{staying} stay"
    )
    basis = {
        "from": name, "apart": two.apart, "spreads": list(spreads), "stay": staying, "sightings": [f.id for f in leaving],
    }  # fmt: skip
    return Decision(
        leaving[-1].stamp, f"{source}/{new}", source, "accepted", "splitting", reason, why, two.apart,
        max(two.limit, 4 * max(spreads)), basis=basis,
    )  # fmt: skip


# -- later sightings -----------------------------------------------------------------------------


def at_their_places(
    offers: Sequence[Offer], a: Keyframe | None, context: Context, config: LandmarkSource, books: Books
) -> tuple[list[Offer], list[Decision]]:
    """Sightings of an id that is at two places get the name of the one that they are of: the closest within the gate, under the joint
    covariance of pose and places. Where both pass, one that was moved is where it was at that time; of two that bear the number none is taken.
    """
    if not books.twins:
        return list(offers), []
    found: list[Offer] = []
    decisions: list[Decision] = []
    scans: dict[tuple[int, str, str], list[Offer]] = defaultdict(list)
    for offer in offers:
        m = offer.measurement
        if isinstance(m, LandmarkObservation) and m.landmark in books.twins:
            scans[m.stamp, m.frame, m.landmark].append(offer)
        else:
            found.append(offer)
    for (_, _, name), scan in scans.items():
        try:
            sorted_, told = _sorted(scan, name, a, context, config, books)
        except Unusable as why:
            sorted_, told = [], [_told(offer, "refused", why.reason, why.detail) for offer in scan]
        found += sorted_
        decisions += told
    return found, decisions


def _sorted(
    scan: Sequence[Offer],
    name: str,
    a: Keyframe | None,
    context: Context,
    config: LandmarkSource,
    books: Books,
) -> tuple[list[Offer], list[Decision]]:
    """Sightings of one id from one place; each of its places is seen once at most."""
    twins = books.twins[name]
    since = twins.since if len(scan) == 1 else None  # what is seen twice at once was not moved
    distances = _distances(scan, twins.names, a, context, config, books)
    limit = chi2_quantile(config.gate, context.space.point_dimension)
    pairs = nearest(distances, limit)
    found, decisions = [], []
    for n, offer in enumerate(scan):
        fits, closest = distances[n] <= limit, float(distances[n].min())
        if not fits.any():
            why = f"{name} is at two places, and this is neither"
            decisions.append(_told(offer, "refused", "elsewhere", why, closest, limit))
        elif n not in pairs or (fits.all() and since is None):
            why = f"{name} is at two places, and this may be of both"
            decisions.append(_told(offer, "refused", "ambiguous", why, closest, limit))
        else:
            m = offer.measurement
            newer = since is not None and m.stamp >= since
            at = int(newer) if fits.all() else pairs[n]
            if at == 0 and newer:  # it is at the first place again: there are two
                books.twins[name] = Twins(twins.names, None)
            found.append(renamed(offer, twins.names[at]))
            why = f"of {twins.names[at]}"
            decisions.append(_told(offer, "accepted", "sorted", why, float(distances[n, at]), limit))
    return found, decisions


def _distances(
    scan: Sequence[Offer],
    names: Sequence[str],
    a: Keyframe | None,
    context: Context,
    config: LandmarkSource,
    books: Books,
) -> Array:
    """(n, 2) squared Mahalanobis distances of sightings and places; infinite where a place has lost all that told of it."""
    placed = context.landing(scan[0].measurement.stamp)
    points, noises = [], []
    for offer in scan:
        m = offer.measurement
        assert isinstance(m, LandmarkObservation)
        if m.form in PLACELESS:
            why = f"{m.landmark} is at two places, and a {m.form} alone does not tell which"
            raise Unusable("ambiguous", why)
        upright, mount = level(positioned(m), context, config)
        point, noise = as_point(upright, mount, placed.motion, context, config)
        points.append(point)
        noises.append(noise)
    part = context.component(placed.keyframe.pose)
    keys = {n: books.landmarks[name] for n, name in enumerate(names)}
    near = {n: key for n, key in keys.items() if context.component(key) == part}
    if not near or any(context.component(key) not in (None, part) for key in keys.values()):
        why = f"{names[0]} is at two places, and this part of the map does not know both"
        raise Unusable("ambiguous", why)
    places = np.array([_place(key, context) for key in near.values()])
    seen, covariance = predicted(placed.keyframe, list(near.values()), places, a, context)
    prediction = Prediction(np.array(points)[:, None] - seen[None], np.array(noises), covariance)
    distances = np.full((len(scan), len(names)), np.inf)
    distances[:, list(near)] = prediction.distances()
    return distances


def _place(key: int, context: Context) -> Array:
    return np.asarray(context.pose(key).translation()) if is_posed(key) else context.point(key)


def _told(
    offer: Offer,
    verdict: Verdict,
    reason: str,
    detail: str,
    statistic: float | None = None,
    threshold: float | None = None,
) -> Decision:
    m = offer.measurement
    return Decision(m.stamp, offer.id, m.source, verdict, "landmark", reason, detail, statistic, threshold)


def twins_of(landmarks: Mapping[str, int], factors: Sequence[Factor]) -> dict[str, Twins]:
    """Of a saved map: the ids that are at two places. One was moved if all of its second place is newer than all of the first."""
    found = {}
    for second in landmarks:
        name = second.removesuffix(SECOND_PLACE)
        if second != name and name in landmarks:
            stamps = [[f.stamp for f in factors if landmarks[each] in f.keys] for each in (name, second)]
            since = min(stamps[1], default=0)
            found[name] = Twins((name, second), since if max(stamps[0], default=0) < since else None)
    return found
