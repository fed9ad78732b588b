"""Whether a measured relative pose and a path between the same two poses say the same, and what it would take."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..config import Gate
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
        turns = np.diag(space.diagonal(1.0, 0.0)) > 0
        self._turns, self._moves = np.flatnonzero(turns), np.flatnonzero(~turns)

    def exact(self, measured: Path, path: Path) -> tuple[float, float]:
        """The statistic if odometry did not err at all, and how far (m) the noise of the loops alone may reach."""
        found = self.compare(measured, path, Noise(odometry=0.0), drift=0.0)
        return found.statistic, found.bound[0]

    @property
    def threshold(self) -> float:
        """Of the statistic, as far as accepted loops leave the gate open."""
        return self.widest * self.usual.factor()

    def compare(
        self, measured: Path, path: Path, noise: Noise = Noise(), drift: float | None = None
    ) -> Accord:  # frozen
        """measured: one relative pose as a path of its own. noise, drift: instead of those that are."""
        drift = self._config.drift if drift is None else drift
        scale = self._config.odometry_scale * noise.odometry**2
        odometry = path.covariance(scale, noise.rotation) - path.loops
        loops = noise.loop**2 * measured.loops + path.loops
        residual = self._space.logmap(path.pose.between(measured.pose))
        threshold = self.threshold
        reach = drift * path.meters
        try:
            statistic = float(residual @ np.linalg.solve(odometry + loops, residual))
        except np.linalg.LinAlgError:
            statistic = np.nan
        if not np.isfinite(statistic):  # numbers near the end of the scale say nothing
            return Accord(np.inf, threshold, (np.inf, np.inf), (reach, 0.0), reach)
        sure = min(reach, _width(odometry, self._moves, threshold))
        # a heading that is off by twice the drift all the way moves the end by more than the drift; it wanders on
        bound = (
            reach + _width(loops, self._moves, self.widest),
            2 * drift * (1 + path.meters / WANDER) + _width(loops, self._turns, self.widest),
        )
        away = float(np.linalg.norm(residual[self._moves])), float(np.linalg.norm(residual[self._turns]))
        return Accord(statistic, threshold, away, bound if sure <= self._near else (np.inf, np.inf), sure)

    def remedy(self, measured: Path, path: Path) -> tuple[Noise, float]:
        """The smallest change with which `compare` would pass: factors of one noise, and the drift.

        Of the odometry's rotation if that helps, else of all odometry, else of the measurement.
        """
        now = self.compare(measured, path)
        drift = self._config.drift if now.possible else self._drift(now, path.meters)
        if self.compare(measured, path, drift=drift):
            return Noise(), drift
        for cause in ("rotation", "odometry", "loop"):
            factor = self._factor(measured, path, cause, drift)
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

    def _factor(self, measured: Path, path: Path, cause: str, drift: float) -> float:
        """By bisection, since the statistic falls as a noise grows; infinite beyond LARGEST, except for the measurement's own."""

        def passes(factor: float) -> bool:
            return bool(self.compare(measured, path, replace(Noise(), **{cause: factor}), drift))

        low, high = 1.0, 2.0
        while not passes(high):
            low, high = high, 2 * high
            if high > LARGEST and cause != "loop":
                return np.inf
        while high - low > PRECISION * low / 2:
            middle = (low + high) / 2
            low, high = (low, middle) if passes(middle) else (middle, high)
        return high


def _width(covariance: Array, axes: Any, threshold: float) -> float:
    """How far along its longest axis a covariance reaches at a threshold."""
    variance = float(np.linalg.eigvalsh(covariance[np.ix_(axes, axes)])[-1])
    return float(np.sqrt(threshold * max(variance, 0.0)))


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
