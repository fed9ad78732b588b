"""Asks the sensors for factors: at a keyframe, with other constants, or where two parts of the map are joined."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from gtsam import symbolIndex

from .association import Associator
from .books import Books
from .coast import NAME, coasts
from .config import LandmarkSource
from .context import Context
from .graph import DATUM, Delta, Factor, Keyframe, Offer, rekeyed, total
from .measurement import Array, Measurement
from .quarantine import let_in
from .reunion import Reunion
from .sensors import SENSORS
from .sensors.camera import CameraModel
from .splitting import at_their_places


class Sensing:
    def __init__(self, books: Books) -> None:
        self._books = books
        self._coasts = coasts(books.config)
        self._cameras: dict[str, CameraModel] = {}
        self._memory: dict[str, Any] = {}  # of sensors, by source
        self.associators = {
            name: Associator(name, source, books.space)
            for name, source in books.config.sources.items()
            if isinstance(source, LandmarkSource)
        }

    def restore(self, landmarks: Mapping[str, int]) -> None:
        """Those of a saved map, by name."""
        for associator in self.associators.values():
            associator.restore(landmarks)

    def see(self, camera: CameraModel) -> None:
        """What a camera says of itself."""
        self._cameras[camera.source] = camera

    def context(self, guesses: Mapping[int, Any]) -> Context:
        books = self._books
        factors = books.solver.factors
        return Context(
            books.space,
            books.applier.estimate,
            guesses,
            books.mounts,
            lambda stamp: books.timeline.place(stamp, books.tracks.of(stamp) or books.track, books.space),
            books.track.motion,
            books.landmark,
            books.parts.of,
            books.waiting.for_variable,
            books.earth,
            books.origin,
            self._gauge,
            DATUM in factors,
            books.stretch,
            books.imu == books.driver,
            kept=factors.__contains__,
            cameras=self._cameras,
            memory=self._memory,
            tag=books.tag,
        )

    def motion(self, stamp: int, a: Keyframe | None, b: Keyframe) -> Delta:
        """What the driving source says of the way from one keyframe to the next."""
        books = self._books
        settings = books.config.sources[books.driver]
        name, kind = (NAME, "odometry") if self._coasts else (books.driver, settings.kind)
        offers = [Offer("", Measurement(stamp, name), motion=True)]
        context = books.calibration.context(self.context({}), books.driver)
        return SENSORS[kind].factors(offers, a, b, context, settings)

    def factors(
        self, window: Sequence[Offer], a: Keyframe | None, b: Keyframe, guesses: Mapping[int, Any]
    ) -> Delta:
        """Ask each sensor, in the order of the configuration, for the factors of its part of the window."""
        if not window:
            return Delta()
        books = self._books
        by_source = _by_source(window)
        deltas: list[Delta] = []
        for name, source in books.config.sources.items():
            if name in by_source:
                context, offers = books.calibration.context(self.context(guesses), name), by_source[name]
                if isinstance(source, LandmarkSource):
                    offers, decisions = self.associators[name].named(offers, a, b, context)
                    offers, told = at_their_places(offers, a, context, source, books)
                    offers, refused = let_in(offers, books.landmarks, books.suspended)
                    books.decisions += decisions + told + refused
                books.calibration.keep(offers)
                deltas.append(SENSORS[source.kind].factors(offers, a, b, context, source))
                guesses = {**guesses, **deltas[-1].values}  # what one has found is there for the next
        return total(deltas)

    def remade(self, constants: Array, anchor: Array) -> dict[str, Factor]:
        """The factors in the graph that rest on constants of their sensors, made with these. anchor: see Calibration.context."""
        books, found = self._books, dict[str, Factor]()
        kept = books.solver.factors
        for name in sorted(books.calibration.sources):
            settings = books.config.sources[name]
            context = books.calibration.context(self.context({}), name, constants, anchor)
            make, last = SENSORS[settings.kind].factors, books.timeline.keyframes[-1]
            if name == books.driver and not self._coasts:
                deltas = [make([offer], a, b, context, settings) for offer, a, b in self._steps(name)]
            else:
                landed = [offer for offer in books.calibration.offers(name) if offer.id in kept]
                deltas = [make(landed, None, last, context, settings)]
            made = (factor for delta in deltas for factor in delta.add)
            found |= {f.id: _of_the_same(f, kept[f.id]) for f in made if f.id in kept}
        return found

    def _steps(self, name: str) -> Iterator[tuple[Offer, Keyframe, Keyframe]]:
        """What the motion factors of a source were made from."""
        books = self._books
        for factor in books.solver.factors.values():
            if factor.kind == "motion" and factor.source == name:
                a, b = (books.timeline.keyframes[symbolIndex(key)] for key in factor.keys)
                yield Offer("", Measurement(b.stamp, name)), a, b

    def common(self, found: Reunion) -> tuple[Factor, ...]:
        """The factors of the sightings that join two parts."""
        books, make = self._books, SENSORS["landmark"].factors
        context = replace(self.context({}), component=lambda _: found.to)
        last, deltas = books.timeline.keyframes[-1], []
        for name, offers in _by_source([wait.offer for wait in found.waits]).items():
            own = books.calibration.context(context, name)
            deltas.append(make(offers, None, last, own, books.config.sources[name]))
        books.decisions += [decision for delta in deltas for decision in delta.decisions]
        return tuple(factor for delta in deltas for factor in delta.add)

    def _gauge(self, key: int) -> str | None:
        """What holds the part of a variable, where the earth may take its place: nothing else will say where the map lies."""
        books = self._books
        part = books.parts.of(key)
        others = books.parts.home is not None or any(
            source.kind == "pose" for source in books.config.sources.values()
        )
        return None if others or part is None or not books.parts.is_loose(part) else books.parts.gauge(part)


def _of_the_same(made: Factor, kept: Factor) -> Factor:
    """A sighting that has become one of another landmark than its message names stays with that."""
    if made.kind != "landmark" or made.keys[1] == kept.keys[1]:
        return made
    return rekeyed(made, made.keys[1], kept.keys[1])


def _by_source(offers: Sequence[Offer]) -> dict[str, list[Offer]]:
    found: dict[str, list[Offer]] = defaultdict(list)
    for offer in offers:
        found[offer.measurement.source].append(offer)
    return found
