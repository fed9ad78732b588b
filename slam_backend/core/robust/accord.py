"""Whether a measured relative pose and a path between the same two poses say the same, and what it would take."""

from dataclasses import dataclass, replace
from math import hypot, inf, isfinite, sqrt

import numpy as np

from ..config import Gate
from ..graph import Pose
from ..measurement import Array
from ..space import Space
from .chi2 import chi2_quantile
from .paths import Path
from .usual import Usual

LARGEST = 1000.0  # factor of a noise beyond which nothing is said about it
WANDER = 100.0  # m over which a heading may wander as far again
PRECISION = 1e-6  # relative, of such a factor


@dataclass(frozen=True, slots=True)
class Noise:
    """Factors of standard deviations, by what they belong to; one everywhere is the noise as it is."""

    rotation: float = 1.0  # of the odometry's rotation
    odometry: float = 1.0  # of all of the odometry
    loop: float = 1.0  # of the measurement itself


@dataclass(frozen=True, slots=True)
class Accord:
    """statistic: squared Mahalanobis distance, against `threshold`. away: residual (m, rad), against `bound` (m, rad), which
    rests on the length of the path alone. sure: how far (m) the path may be off, by its covariance or its length.
    """

    statistic: float
    threshold: float
    away: tuple[float, float]
    bound: tuple[float, float]
    sure: float

    @property
    def likely(self) -> bool:
        return self.statistic <= self.threshold

    @property
    def possible(self) -> bool:
        """Whether odometry may have drifted so far at all, whatever its covariance says."""
        return self.away[0] <= self.bound[0] and self.away[1] <= self.bound[1]

    def __bool__(self) -> bool:
        return self.likely and self.possible


class Ruler:
    """Compares relative poses. Settings: those of the gate."""

    def __init__(self, space: Space, config: Gate, usual: Usual, near: float = np.inf) -> None:
        """near: how long odometry is believed not to drift by more than `gate.drift`: while that is below so many metres."""
        self._space, self._config, self.usual, self._near = space, config, usual, near
        self.widest = chi2_quantile(config.probability, space.dimension)
        self._turns, self._moves = _axes(space.diagonal(1.0, 0.0)), _axes(space.diagonal(0.0, 1.0))

    def exact(self, measured: Path, expected: Pose, noise: Array) -> float:
        """The statistic if what is expected were true to within a noise that leaves out the odometry's; infinite where that noise is
        so wide that an end further off than `near` would be as likely.
        """
        loops = measured.loops + noise
        statistic = _distance(self._space.logmap(expected.between(measured.pose)), loops)
        reach = _width(loops[self._moves, self._moves], statistic)
        return statistic if reach <= self._near else inf

    @property
    def threshold(self) -> float:
        """Of the statistic, as far as accepted loops leave the gate open."""
        return self.widest * self.usual.factor()

    def compare(
        self, measured: Path, path: Path, noise: Noise = Noise(), drift: float | None = None
    ) -> Accord:  # frozen
        """measured: one relative pose as a path of its own. noise, drift: instead of those that are."""
        drift = self._config.drift if drift is None else drift
        odometry = path.drifted(self._config.odometry_scale * noise.odometry**2, noise.rotation)
        loops = noise.loop**2 * measured.loops + path.loops
        residual = self._space.logmap(path.pose.between(measured.pose))
        threshold, reach = self.threshold, drift * path.meters
        statistic = _distance(residual, odometry + loops)
        if statistic == inf:  # numbers near the end of the scale say nothing
            return Accord(inf, threshold, (inf, inf), (reach, 0.0), reach)
        sure = min(reach, _width(odometry[self._moves, self._moves], threshold))
        bound = (inf, inf)
        if sure <= self._near:
            # a heading that is off by twice the drift all the way moves the end by more than the drift; it wanders on
            turned = 2 * drift * (1 + path.meters / WANDER)
            bound = (
                reach + _width(loops[self._moves, self._moves], self.widest),
                turned + _width(loops[self._turns, self._turns], self.widest),
            )
        away = _length(residual[self._moves]), _length(residual[self._turns])
        return Accord(statistic, threshold, away, bound, sure)

    def remedy(self, measured: Path, path: Path) -> tuple[Noise, float]:
        """The smallest change with which `compare` would pass: factors of one noise, and the drift.

        Of the odometry's rotation if that helps, else of all odometry, else of the measurement.
        """
        now = self.compare(measured, path)
        drift = self._config.drift if now.possible else self._drift(now, path.meters)
        if self.compare(measured, path, drift=drift):
            return Noise(), drift
        for cause in ("rotation", "odometry", "loop"):
            factor = self._factor(measured, path, cause)
            if factor <= LARGEST:
                break
        return replace(Noise(), **{cause: factor}), drift

    def _drift(self, now: Accord, meters: float) -> float:
        """With which the residual would be possible, as far as drift can help."""
        drift = self._config.drift
        over = [
            (away - bound) / share
            for away, bound, share in zip(now.away, now.bound, (meters, 2 + 2 * meters / WANDER), strict=True)
            if share > 0
        ]
        return (drift + max(0.0, *over)) * (1 + PRECISION)

    def _factor(self, measured: Path, path: Path, cause: str) -> float:
        """With which the statistic passes, by bisection, since it falls as a noise grows; infinite beyond LARGEST, except for the
        measurement's own.
        """
        odometry = path.drifted(self._config.odometry_scale)
        parts = {
            "rotation": self._config.odometry_scale * path.rotation, "odometry": odometry, "loop": measured.loops
        }  # fmt: skip
        grows = parts[cause]
        rest = odometry + measured.loops + path.loops - grows
        residual = self._space.logmap(path.pose.between(measured.pose))
        threshold = self.threshold

        def passes(factor: float) -> bool:
            return _distance(residual, rest + factor**2 * grows) <= threshold

        low, high = 1.0, 2.0
        while not passes(high):
            low, high = high, 2 * high
            if high > LARGEST and cause != "loop":
                return inf
        while high - low > PRECISION * low / 2:
            middle = (low + high) / 2
            low, high = (low, middle) if passes(middle) else (middle, high)
        return high * (1 + PRECISION / 2)


def _axes(diagonal: Array) -> slice:
    """Those on which it is not zero; they lie side by side."""
    rows = np.flatnonzero(np.diag(diagonal))
    return slice(int(rows[0]), int(rows[-1]) + 1)


def _distance(residual: Array, covariance: Array) -> float:
    """Squared, by Mahalanobis; infinite where the numbers allow none."""
    try:
        found = float(residual @ np.linalg.solve(covariance, residual))
    except np.linalg.LinAlgError:
        return inf
    return found if isfinite(found) else inf


def _width(covariance: Array, threshold: float) -> float:
    """How far along its longest axis a covariance reaches at a threshold."""
    if len(covariance) == 1:
        variance = float(covariance[0, 0])
    elif len(covariance) == 2:
        (a, b), (_, c) = covariance.tolist()
        variance = (a + c) / 2 + hypot((a - c) / 2, b)
    else:
        variance = float(np.linalg.eigvalsh(covariance)[-1])
    return sqrt(threshold * max(variance, 0.0))


def _length(vector: Array) -> float:
    return sqrt(float(vector @ vector))


def told(noise: Noise, drift: float, usual: float) -> tuple[dict[str, float], str]:
    """A remedy as data, and as a sentence. usual: the drift that is configured."""
    data: dict[str, float] = {}
    words: list[str] = []
    for cause, what in (
        ("rotation", "the odometry's yaw noise were"),
        ("odometry", "the odometry's noise were"),
        ("loop", "its own noise were"),
    ):
        if (factor := getattr(noise, cause)) > 1:
            data[cause] = factor
            words.append(f"{what} {factor:.3g} times larger")
    if drift > usual:
        data["drift"] = drift
        words.append(f"gate.drift were {drift:.3g} instead of {usual:g}")
    return data, f"would pass if {' and '.join(words)}"
