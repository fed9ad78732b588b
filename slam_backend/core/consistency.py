"""Whether the noise of each source is what it says: squares of residuals against what the other factors leave of them.

A fit takes up part of every residual. What stays is, for each row of the whitened problem A dx = b, the diagonal of the redundancy matrix
I - A (A^T A)^-1 A^T (Förstner, Reliability analysis of parameter estimation, 1979). Its sum over a source is the number of degrees of
freedom with which the others check it: chi-square is that on average if every noise is stated truly, and the ratio of the two is the
factor by which the stated variances are wrong. The diagonal is estimated by fitting white noise DRAWS times and looking at what is left.
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from typing import Any, NamedTuple

import gtsam
import numpy as np

from .config import Config, OdometrySource
from .graph import HOLDING, Factor
from .measurement import Array
from .robust.kernels import without_kernel
from .trajectory import Stamps

DRAWS = 4
PLACEHOLDER = 1e-5  # norm of a whitened row that measures nothing, as x and y of a height
LITTLE = 3.0  # degrees of freedom, below which nothing can be said
CERTAIN = 3.29  # standard deviations of a ratio, beyond which it is told as wrong (99.9 %), if it is
NOTABLE = 1.25  # times off in standard deviations, or more
FIXED = 1e6  # whitened weight of what is held where it is

_PLANE = ("x m", "y m", "yaw rad")
_SPACE = ("roll rad", "pitch rad", "yaw rad", "x m", "y m", "z m")
AXES: Mapping[
    str, tuple[str, ...]
] = {  # what the rows of gtsam's factors measure, and its unit; of others all rows are one axis
    "BetweenFactorPose2": _PLANE,
    "PriorFactorPose2": _PLANE,
    "BetweenFactorPose3": _SPACE,
    "PriorFactorPose3": _SPACE,
    "BearingRangeFactor2D": ("bearing rad", "range m"),
    "BearingRangeFactor3D": ("bearing rad", "bearing rad", "range m"),
    "BearingFactor2D": ("bearing rad",),
    "BearingFactor3D": ("bearing rad", "bearing rad"),
    "PoseTranslationPrior3D": ("x m", "y m", "z m"),
    "AttitudeFactorPose3": ("tilt rad", "tilt rad"),
}
POSITION = "position m"  # of factors whose noise is stated for the place of an antenna alone
UNJUDGED = HOLDING | {"earth"}  # kinds


class Ratio(NamedTuple):
    """squares: of residuals in standard deviations, summed. free: degrees of freedom that check them. stated: root mean square of
    the standard deviations.
    """

    squares: float
    free: float
    stated: float = 1.0

    @property
    def value(self) -> float | None:
        """None where too little checks it."""
        return self.squares / self.free if self.free >= LITTLE else None

    @property
    def bounds(self) -> tuple[float, float]:
        """Between which the value lies with 95 % if the noise is stated truly."""
        spread = 1.96 * sqrt(2 / self.free)
        return max(1 - spread, 0.0), 1 + spread

    @property
    def is_off(self) -> bool:
        """Certainly, and by so much that it matters."""
        value = self.value
        if value is None or abs(value - 1) <= CERTAIN * sqrt(2 / self.free):
            return False
        return not 1 / NOTABLE < sqrt(value) < NOTABLE

    @property
    def times(self) -> float:
        """What the standard deviation is to be multiplied by."""
        return sqrt(self.value or 1.0)


@dataclass(frozen=True, slots=True)
class Consistency:
    """Of one source. axes: by name and unit, as `yaw rad`; none where its factors have no axes that people would know."""

    factors: int
    whole: Ratio
    axes: Mapping[str, Ratio]

    @property
    def advice(self) -> str:
        """In words; empty where its noise is as it says, or nobody can tell."""
        return "; ".join(_advice(axis, ratio) for axis, ratio in self.axes.items() if ratio.is_off)

    def as_json(self) -> dict[str, Any]:
        axes = {
            axis: _told(ratio) | ({"advice": _advice(axis, ratio)} if ratio.is_off else {})
            for axis, ratio in self.axes.items()
        }
        return {"factors": self.factors, **_told(self.whole), "axes": axes, "advice": self.advice}


def _advice(axis: str, ratio: Ratio) -> str:
    name, _, unit = axis.partition(" ")
    word, times = ("optimistic", ratio.times) if ratio.times > 1 else ("pessimistic", 1 / ratio.times)
    return f"{times:.1f}x {word} in {name}: use {ratio.times * ratio.stated:.2g} {unit} instead of {ratio.stated:.2g}"


def _told(ratio: Ratio) -> dict[str, Any]:
    told: dict[str, Any] = {"chi_square": round(ratio.squares, 6), "expected": round(ratio.free, 6)}
    if (value := ratio.value) is not None:
        told |= {"ratio": value, "bounds_95": list(ratio.bounds)}
    if ratio.stated != 1.0:
        told |= {"stated": ratio.stated, "suggested": ratio.times * ratio.stated}
    return told


class Fit:
    """Factors at an estimate, robust weights included; inactive ones are left out."""

    def __init__(
        self, factors: Iterable[Factor], values: gtsam.Values, free: Callable[[int], bool] = lambda _: True
    ) -> None:
        """free: which variables the fit may move; the others are held where they are. sizes: of each variable, in order of keys."""
        pairs = [(f, each) for f in factors if (each := f.factor.linearize(values)) is not None]
        self.factors = [factor for factor, _ in pairs]
        self.linear = [each for _, each in pairs]
        self.systems: list[tuple[Array, Array]] = [each.jacobian() for each in self.linear]
        zeros = values.zeroVectors()
        keys = sorted({key for factor in self.factors for key in factor.keys})
        self.sizes = {key: len(zeros.at(key)) for key in keys}
        self._held = [key for key in keys if not free(key)]

    @cached_property
    def rows(self) -> Stamps:
        """(F,) of each factor."""
        return np.array([len(errors) for _, errors in self.systems], dtype=np.int64)

    @cached_property
    def residuals(self) -> Array:
        """(R,) whitened, of all factors one after the other."""
        return np.concatenate([np.zeros(0), *(errors for _, errors in self.systems)])

    @cached_property
    def left(self) -> Array:
        """(DRAWS, R) what a fit leaves of white noise; all zero where the factors do not determine the variables."""
        noise = np.random.default_rng(0).standard_normal((DRAWS, len(self.residuals)))
        try:
            left = self._unfitted(noise)
        except RuntimeError:  # gtsam: an indeterminate system
            return np.zeros_like(noise)
        sound = np.linalg.norm(left) <= np.linalg.norm(noise)  # else it is nearly so, and NaN is not
        return left if sound else np.zeros_like(noise)

    def _unfitted(self, noise: Array) -> Array:
        """Each draw, without A (A^T A)^-1 A^T of it, by R^T R = A^T A; nothing in rows that measure nothing."""
        graph: Any = gtsam.GaussianFactorGraph()
        for each in self.linear:
            graph.push_back(each)
        row, column, entry = graph.sparseJacobian_()
        row, column = row.astype(np.int64) - 1, column.astype(np.int64) - 1
        width = sum(self.sizes.values())
        inner = column < width  # the right-hand side comes last
        row, column, entry = row[inner], column[inner], entry[inner]
        noise = noise * (np.bincount(row, entry**2, noise.shape[1]) >= PLACEHOLDER**2)
        for key in self._held:
            size = self.sizes[key]
            graph.add(key, FIXED * np.eye(size), np.zeros(size))
        net = graph.eliminateSequential(gtsam.Ordering.OrderingType.COLAMD, gtsam.EliminateQR)
        left = []
        for draw in noise:
            right = np.bincount(column, entry * draw[row], width).astype(np.float64)
            found = net.backSubstitute(net.backSubstituteTranspose(self._vectors(right))).vector()
            left.append(draw - np.bincount(row, entry * found[column], len(draw)))
        return np.array(left)

    def _vectors(self, flat: Array) -> gtsam.VectorValues:
        vectors, at = gtsam.VectorValues(), 0
        for key, size in self.sizes.items():
            vectors.insert(key, flat[at : at + size])
            at += size
        return vectors

    @property
    def free(self) -> Array:
        """(F,) degrees of freedom of each factor that the others check. A sum has a relative error of about sqrt(2 / DRAWS / sum)."""
        squares = (self.left**2).mean(axis=0)
        return np.add.reduceat(squares, self._starts) if len(self.rows) else np.zeros(0)

    @property
    def _starts(self) -> Stamps:
        return np.asarray(np.cumsum(self.rows) - self.rows)

    def consistency(self, blind: Collection[tuple[str, str]] = ()) -> dict[str, Consistency]:
        """By source. blind: (source, axis) of what a source does not measure, and states widely."""
        alike: dict[str, dict[tuple[str, int], list[int]]] = defaultdict(lambda: defaultdict(list))
        for n, (factor, rows) in enumerate(zip(self.factors, self.rows.tolist(), strict=True)):
            if factor.kind not in UNJUDGED:
                alike[factor.source][type(factor.factor).__name__, rows].append(n)
        axes = {source: [axis for who, axis in blind if who == source] for source in alike}
        return {source: self._of(groups, axes[source]) for source, groups in alike.items()}

    def _of(self, groups: Mapping[tuple[str, int], list[int]], blind: Collection[str]) -> Consistency:
        """groups: of factors of the same type with as many rows."""
        axes: dict[str, Ratio] = {}
        whole = Ratio(0.0, 0.0)
        for (type_, height), numbers in groups.items():
            rows = self._starts[numbers, None] + np.arange(height)
            squares, left = self.residuals[rows] ** 2, (self.left[:, rows] ** 2).mean(axis=0)
            whole = _sum(whole, Ratio(float(squares.sum()), float(left.sum())))
            for axis, ratio in self._by_axis(numbers, rows, AXES[type_]) if type_ in AXES else ():
                if axis.partition(" ")[0] not in blind:
                    axes[axis] = _sum(axes[axis], ratio) if axis in axes else ratio
        if blind:
            whole = Ratio(*(sum(each[n] for each in axes.values()) for n in (0, 1)))
        return Consistency(sum(map(len, groups.values())), whole, axes)

    def _by_axis(
        self, numbers: Sequence[int], rows: Stamps, names: Sequence[str]
    ) -> Iterator[tuple[str, Ratio]]:
        """Residuals turned back from whitened rows to the factor's own axes, each in its own standard deviations."""
        roots = np.array([without_kernel(self.factors[n].factor.noiseModel()).R() for n in numbers])
        if (np.abs(np.diagonal(roots, axis1=1, axis2=2)) > 0).all():
            mixed = np.linalg.inv(roots)
            sigmas = np.linalg.norm(mixed, axis=2)
            turns = mixed / sigmas[:, :, None]
        else:  # of a place alone: rows are its axes, and some are empty
            lengths = np.linalg.norm(roots[:, :, [axis.endswith(" m") for axis in names]], axis=2)
            filled = lengths[0] > 0
            rows, sigmas = rows[:, filled], 1 / lengths[:, filled]
            turns = np.tile(np.eye(rows.shape[1]), (len(rows), 1, 1))
            names = [POSITION] * rows.shape[1]
        squares = np.einsum("nij,nj->ni", turns, self.residuals[rows]) ** 2
        left = np.einsum("nij,dnj->dni", turns, self.left[:, rows]) ** 2
        stated = np.sqrt((sigmas**2).mean(axis=0))
        sums = zip(squares.sum(axis=0), left.mean(axis=0).sum(axis=0), stated, strict=True)
        yield from zip(names, (Ratio(*map(float, each)) for each in sums), strict=True)


def blind_axes(config: Config) -> list[tuple[str, str]]:
    """What sources do not measure: (source, axis)."""
    planar = [
        name
        for name, source in config.sources.items()
        if isinstance(source, OdometrySource) and source.planar
    ]
    return [(name, axis) for name in planar for axis in ("roll", "pitch", "z")]


def _sum(one: Ratio, other: Ratio) -> Ratio:
    free = one.free + other.free
    mean = (one.free * one.stated**2 + other.free * other.stated**2) / free if free else one.stated**2
    return Ratio(one.squares + other.squares, free, sqrt(mean))
