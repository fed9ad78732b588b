"""What is constant and wrong about a sensor: how many times too long its ranges are, where it sits, how late it is told.

Estimated jointly with the whole graph: Gauss-Newton on poses, landmarks and constants at once, since taking turns does not work (the
landmarks move and absorb the error). The constants are one more variable of the linear system, eliminated last. Their columns are
differences of the factors that the sensor itself makes with constants a little larger and a little smaller, so that no sensor has code
for it, and the graph between two estimates is one of native factors with these constants composed into the measurements.

It is done at keyframes whose number grows by GROWTH, so that its cost stays linear, and at the end of the input. A constant
that is not known better than OBSERVABLE of what was known before is not observable: it is left as it was, and that is said.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C
from numpy.typing import NDArray

from .config import Config
from .context import Context, Correction
from .errors import BadConfig
from .graph import Decision, Factor, Motion, Offer
from .keyframes import Placed
from .measurement import SECOND, Array, format_stamp
from .robust.kernels import without_kernel
from .space import Space
from .variables import is_posed

FIRST = 40  # keyframes before the first estimate
GROWTH = 1.5
ROUNDS = 8
SMALL = 0.1  # standard deviations: a smaller step is the last
RISE = (
    0.01  # of the cost, above which a step is halved; less may be the noise that changes with a time offset
)
DONE = 0.25  # standard deviations: constants that differ by less need not be put in force
OBSERVABLE = 0.5  # of the standard deviation of what was known before
MOUNT = ("translation", "rotation")
GIVEN = {
    "range_scale": 1.0,
    "distance_scale": 1.0,
    "turn_scale": 1.0,
    "distance_per_radian": 0.0,
    "turn_per_meter": 0.0,
    "time_offset": 0.0,
}  # settings, and what does nothing
TINY = 1e-12  # m: of a way of nothing, nothing is lost
KEY = int(C(0))  # of the constants, in the linear system only

Rebuild = Callable[[Array, Array], dict[str, Factor]]  # constants, anchor (see `context`) -> factors by id


class Quantity(NamedTuple):
    """prior: standard deviation of what is known of it without data. step: for differences. In `unit`."""

    prior: float
    step: float
    unit: str


QUANTITIES: Mapping[str, Quantity] = {
    "range_scale": Quantity(0.2, 1e-4, ""),
    "distance_scale": Quantity(0.2, 1e-4, ""),
    "turn_scale": Quantity(0.2, 1e-4, ""),
    "distance_per_radian": Quantity(0.2, 1e-4, "m/rad"),
    "turn_per_meter": Quantity(0.2, 1e-4, "rad/m"),
    "time_offset": Quantity(0.5, 1e-3, "s"),
    "translation": Quantity(0.5, 1e-4, "m"),
    "rotation": Quantity(0.5, 1e-4, "rad"),
}


@dataclass(frozen=True, slots=True)
class Constant:
    """One column: of which source, of what, and which axis of it (of a mount: x y z in the sensor)."""

    source: str
    name: str
    axis: int = 0

    @property
    def quantity(self) -> Quantity:
        return QUANTITIES[self.name]

    def __str__(self) -> str:
        return f"{self.name}.{'xyz'[self.axis]}" if self.name in ("translation", "rotation") else self.name


class Found(NamedTuple):
    """value: as it is in force; sigma: None while it is not observable."""

    value: float
    sigma: float | None


class Calibration:
    """The constants of all sources: in force, and how well they are known."""

    def __init__(self, config: Config, space: Space) -> None:
        self._space, self._config = space, config
        self.constants = [
            constant
            for source, settings in config.sources.items()
            for name in getattr(settings, "calibrate", ())
            for constant in _columns(space, source, name)
        ]
        self.sources = frozenset(each.source for each in self.constants)
        for name, settings in config.sources.items():
            if settings.kind == "odometry" and name != config.driver and _differs(settings):
                raise BadConfig(
                    f"source '{name}': only '{config.driver}', which drives the keyframes, has scales"
                )
        self._vector = np.zeros(len(self.constants))
        self._sigmas: list[float | None] = [None] * len(self.constants)
        self._offers: dict[str, list[Offer]] = {source: [] for source in self.sources}
        self._due = FIRST
        self._acts = any(_differs(settings) for settings in config.sources.values())

    def __bool__(self) -> bool:
        return bool(self.constants)

    @property
    def found(self) -> dict[str, dict[str, Found]]:
        """By source and constant, as the configuration would say it."""
        told: dict[str, dict[str, Found]] = {source: {} for source in sorted(self.sources)}
        for constant, number, sigma in zip(self.constants, self._vector.tolist(), self._sigmas, strict=True):
            told[constant.source][str(constant)] = self._shown(constant, number, sigma)
        return told

    @property
    def late(self) -> dict[str, int]:
        """What is added to the stamps of each source, in ns."""
        offsets = {source: self._correction(source, None).time_offset for source in self._config.sources}
        return {source: round(seconds * SECOND) for source, seconds in offsets.items() if seconds}

    def keep(self, window: Iterable[Offer]) -> None:
        """Measurements of calibrated sources: their factors are made anew with other constants."""
        for offer in window:
            if offer.measurement.source in self.sources:
                self._offers[offer.measurement.source].append(offer)

    def offers(self, source: str) -> Sequence[Offer]:
        """Each once, though it may have waited and come again."""
        return list({offer.id: offer for offer in self._offers[source]}.values())

    def context(
        self, context: Context, source: str, vector: Array | None = None, anchor: Array | None = None
    ) -> Context:
        """What a source sees: its own constants, and motion by those of the driving one.

        vector: other constants than those in force. anchor: those by which each measurement finds its keyframe, so that it
        stays at that one whatever its time offset.
        """
        if not self._acts:
            return context
        own, driving = self._correction(source, vector), self._correction(self._config.driver or "", vector)
        late = round(own.time_offset * SECOND)
        home = late if anchor is None else round(self._correction(source, anchor).time_offset * SECOND)

        def moved(start: int, end: int) -> Motion:
            return _corrected(self._space, context.motion(start, end), driving)

        def placed(stamp: int) -> Placed | None:
            found = context.place(stamp + home)
            if found is None or (home != late and context.place(stamp + late) is None):
                return None
            if home != late:
                return Placed(found.keyframe, moved(found.keyframe.stamp, stamp + late))
            return replace(found, motion=found.motion and _corrected(self._space, found.motion, driving))

        return replace(context, correction=own, place=placed, motion=moved)

    def is_due(self, keyframes: int) -> bool:
        if not self or keyframes < self._due:
            return False
        while self._due <= keyframes:
            self._due = int(self._due * GROWTH) + 1
        return True

    def estimate(
        self, factors: Mapping[str, Factor], values: gtsam.Values, rebuild: Rebuild, stamp: int
    ) -> tuple[Array, gtsam.Values, tuple[Decision, ...]]:
        """Better constants, the values that go with them, and what was decided. They are in force after `take`.

        factors: all of the graph. rebuild: constants -> those of the factors that rest on them, by id.
        """
        active, vector, sigmas = np.ones(len(self.constants), dtype=bool), self._vector, np.array([])
        priors = np.array([constant.quantity.prior for constant in self.constants])
        moved = values
        while active.any():
            try:
                vector, moved, sigmas = self._descended(factors, values, rebuild, active)
            except RuntimeError as error:  # gtsam's only word for a system that cannot be solved
                return self._vector, values, (self._failed(stamp, str(error)),)
            unknown = active & ~(sigmas <= OBSERVABLE * priors)
            if not unknown.any():
                break
            active &= ~unknown
        if not active.any():
            vector, moved = self._vector, values
        return (
            vector,
            moved,
            tuple(self._decided(stamp, k, vector, sigmas, known) for k, known in enumerate(active.tolist())),
        )

    def take(self, vector: Array) -> None:
        self._vector = vector

    def matters(self, vector: Array) -> bool:
        """Whether the constants differ from those in force by more than they are uncertain."""
        known = np.array([np.inf if sigma is None else sigma for sigma in self._sigmas])
        return bool((np.abs(vector - self._vector) > DONE * known).any())

    def _descended(
        self, factors: Mapping[str, Factor], values: gtsam.Values, rebuild: Rebuild, active: NDArray[np.bool_]
    ) -> tuple[Array, gtsam.Values, Array]:
        """Gauss-Newton; a step that does not lower the cost is halved."""
        vector, last = self._vector.copy(), np.inf
        made = rebuild(vector, vector)
        fixed = self._others(factors, made)
        step, towards, sigmas, share = (
            np.zeros_like(vector),
            gtsam.VectorValues(),
            np.full(len(vector), np.inf),
            1.0,
        )
        here, at = values, vector
        for _ in range(ROUNDS):
            cost = fixed.error(values) + sum(factor.factor.error(values) for factor in made.values())
            if cost > last * (1 + RISE):
                share /= 2
            else:
                last, here, at, share = cost, values, vector, 1.0
                step, towards, sigmas = self._step(fixed, made, rebuild, here, at, active)
                if (np.abs(step)[active] < SMALL * sigmas[active]).all():
                    break
            vector = at + share * step
            values = here.retract(_times(towards, share))
            made |= {id_: factor for id_, factor in rebuild(vector, vector).items() if id_ in made}
        return at, here, sigmas

    def _others(
        self, factors: Mapping[str, Factor], made: Mapping[str, Factor]
    ) -> gtsam.NonlinearFactorGraph:
        """All that does not rest on the constants. Of what does and lands no more with these, at an end of the trajectory, only
        what holds a variable that nothing else holds: it says what other constants made of it.
        """
        graph, held, lost = gtsam.NonlinearFactorGraph(), set[int](), []
        for id_, factor in factors.items():
            if id_ not in made and factor.source in self.sources:
                lost.append(factor)
                continue
            held.update(factor.keys)
            if id_ not in made:
                graph.add(factor.factor)
        for factor in lost:
            if not held.issuperset(factor.keys):
                graph.add(factor.factor)
        return graph

    def _step(
        self,
        fixed: gtsam.NonlinearFactorGraph,
        made: Mapping[str, Factor],
        rebuild: Rebuild,
        values: gtsam.Values,
        vector: Array,
        active: NDArray[np.bool_],
    ) -> tuple[Array, gtsam.VectorValues, Array]:
        """Of the constants, of all else, and the standard deviations of the constants."""
        system = fixed.linearize(values)
        columns = np.flatnonzero(active)
        priors = np.array([constant.quantity.prior for constant in self.constants])[columns]
        system.add(
            gtsam.JacobianFactor(
                KEY,
                np.diag(1 / priors),
                -vector[columns] / priors,
                gtsam.noiseModel.Unit.Create(len(columns)),
            )
        )
        differences = [self._difference(rebuild, vector, int(k)) for k in columns]
        for factor in made.values():
            column = np.stack([each(factor, values) for each in differences], axis=1)
            system.add(self._bordered(factor, values, column))
        ordering = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(system, [KEY])
        net = system.eliminateSequential(ordering)
        solution, last = net.optimize(), net.at(net.size() - 1)
        step, sigmas = np.zeros(len(vector)), np.full(len(vector), np.inf)
        step[columns] = solution.at(KEY)
        inverse = np.linalg.inv(last.R())
        sigmas[columns] = np.sqrt(np.diag(inverse @ inverse.T))
        towards = gtsam.VectorValues()
        for key in values.keys():  # noqa: SIM118  # gtsam's Values are no mapping
            towards.insert(key, solution.at(key))
        return step, towards, sigmas

    def _difference(self, rebuild: Rebuild, vector: Array, k: int) -> Callable[[Factor, gtsam.Values], Array]:
        """How the whitened error of each factor changes with a constant. A scale is one of the noise, too, or the smallest world would
        fit best; a time offset is not, or the most uncertain moment would.
        """
        step, is_scale = self.constants[k].quantity.step, self.constants[k].name.endswith("scale")
        beside = np.zeros(len(vector))
        beside[k] = step
        more, less = rebuild(vector + beside, vector), rebuild(vector - beside, vector)

        def derivative(factor: Factor, values: gtsam.Values) -> Array:
            above, below = (each.get(factor.id, factor).factor for each in (more, less))
            if is_scale:
                return np.asarray((above.whitenedError(values) - below.whitenedError(values)) / (2 * step))
            change = (above.unwhitenedError(values) - below.unwhitenedError(values)) / (2 * step)
            return np.asarray(without_kernel(factor.factor.noiseModel()).whiten(change))

        return derivative

    def _bordered(self, factor: Factor, values: gtsam.Values, column: Array) -> Any:
        """The linearized factor with columns for the constants beside those of its variables."""
        matrix, vector = factor.factor.linearize(values).jacobian()
        whitened = _weight(factor.factor, values) * column
        terms: tuple[Any, ...] = ()
        at = 0
        for key in factor.keys:
            size = self._space.dimension if is_posed(key) else self._space.point_dimension
            terms += (key, matrix[:, at : at + size])
            at += size
        make: Any = gtsam.JacobianFactor  # its overloads cannot be told apart by a type checker
        return make(*terms, KEY, whitened, vector, gtsam.noiseModel.Unit.Create(len(vector)))

    def _correction(self, source: str, vector: Array | None) -> Correction:
        numbers = self._vector if vector is None else vector
        settings = self._config.sources.get(source)
        told: dict[str, Any] = {name: getattr(settings, name, start) for name, start in GIVEN.items()}
        six = np.zeros(6)
        for constant, number in zip(self.constants, numbers.tolist(), strict=True):
            if constant.source != source:
                continue
            if constant.name in MOUNT:
                six[MOUNT.index(constant.name) * 3 + constant.axis] = number
            elif constant.name.endswith("scale"):
                told[constant.name] *= 1 + number
            else:
                told[constant.name] += number
        return Correction(**told, mount=self._space.from_extrinsics(six.tolist()) if six.any() else None)

    def _shown(self, constant: Constant, number: float, sigma: float | None) -> Found:
        start = float(getattr(self._config.sources[constant.source], constant.name, 0.0))
        if not constant.name.endswith("scale"):
            return Found(start + number, sigma)
        return Found(start * (1 + number), None if sigma is None else start * sigma)

    def _decided(self, stamp: int, k: int, vector: Array, sigmas: Array, known: bool) -> Decision:
        constant = self.constants[k]
        sigma = float(sigmas[k]) if np.isfinite(sigmas[k]) else None
        threshold = OBSERVABLE * constant.quantity.prior
        shown = self._shown(constant, float(vector[k]), sigma)
        self._sigmas[k] = sigma if known else None
        unit = f" {constant.quantity.unit}" if constant.quantity.unit else ""
        detail = f"{constant} of {constant.source} is not observable yet: left at {shown.value:.5g}{unit}"
        if known:
            detail = f"{constant} of {constant.source} is {shown.value:.5g} +- {shown.sigma:.2g}{unit}"
        return Decision(
            stamp, f"calibration/{constant.source}/{constant}/{format_stamp(stamp)}", constant.source,
            "accepted" if known else "refused", "calibration", "estimated" if known else "unobservable",
            detail, sigma, threshold, basis={"value": shown.value, "sigma": shown.sigma},
        )  # fmt: skip

    def _failed(self, stamp: int, why: str) -> Decision:
        return Decision(
            stamp, f"calibration/{format_stamp(stamp)}", min(self.sources), "refused", "calibration", "unsolvable",
            f"constants and graph could not be solved together: {why.splitlines()[0][:120]}",
        )  # fmt: skip


def _differs(settings: Any) -> bool:
    """Whether there is anything to correct about a source."""
    told = any(getattr(settings, name, start) != start for name, start in GIVEN.items())
    return told or bool(getattr(settings, "calibrate", ()))


def _columns(space: Space, source: str, name: str) -> list[Constant]:
    """A mount has the axes of the space: x, y and yaw in the plane."""
    turned = range(3) if space.name == "3d" else (2,)
    axes = {"translation": range(space.point_dimension), "rotation": turned}
    parts = MOUNT if name == "mount" else (name,)
    return [Constant(source, part, axis) for part in parts for axis in axes.get(part, (0,))]


def _corrected(space: Space, motion: Motion, driving: Correction) -> Motion:
    """A motion as it was, along its constant twist. Beside the scales: unequal wheels turn in proportion to the way (Borenstein & Feng,
    T-RA 1996), and wheels that slip or lag in a turn lose way in proportion to it, at most all of it.
    """
    if driving.is_faultless:
        return motion
    turns = np.diag(space.diagonal(1.0, 0.0)) > 0
    scale = np.where(turns, driving.turn_scale, driving.distance_scale)
    told = space.logmap(motion.pose)
    twist = told / scale
    if driving.distance_per_radian:
        meters, lost = _size(twist[~turns]), driving.distance_per_radian * _size(told[turns])
        twist[~turns] *= max(0.0, 1 - lost / max(meters, TINY))
    if driving.turn_per_meter:
        twist[np.flatnonzero(turns)[-1]] -= driving.turn_per_meter * twist[np.flatnonzero(~turns)[0]]
    return Motion(space.expmap(twist), motion.covariance / scale[:, None] / scale)


def _size(vector: Array) -> float:
    return float(np.linalg.norm(vector))


def _weight(factor: Any, values: gtsam.Values) -> float:
    """By which gtsam multiplies the whitened error when it linearizes: the root of the kernel's weight."""
    noise: Any = factor.noiseModel()
    if not isinstance(noise, gtsam.noiseModel.Robust):
        return 1.0
    kernel: Any = noise.robust()
    return float(np.sqrt(kernel.weight(float(np.linalg.norm(factor.whitenedError(values))))))


def _times(towards: gtsam.VectorValues, share: float) -> gtsam.VectorValues:
    return towards if share == 1.0 else towards.scale(share)
