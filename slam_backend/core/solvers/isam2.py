"""iSAM2 that survives: incremental smoothing over the whole trajectory (Kaess et al., IJRR 2012).

After gtsam.ISAM2 throws, its state is poisoned: the next update silently "works" and answers garbage. So the factors
are stored here, and after any failure the ISAM2 is dropped and rebuilt from them, rung by rung:

    QR from the last linearization point, re-linearized until nothing moves
    batch Levenberg-Marquardt, then QR from its optimum
    the same without the factors of the change that cannot be solved: SolverFailure names them
    without earlier ones too: what is kept then, see salvage

Cholesky is about twice as fast as QR on graphs rich in loops, but throws on long open trajectories and on
strongly anisotropic information; once it has thrown for no single factor's fault, QR serves for the rest of the run.
"""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from math import isfinite
from typing import Any

import gtsam
import numpy as np

from ..config import Config
from ..errors import SolverFailure
from ..firewall.rules import FARTHEST
from ..graph import Decision, Delta, Estimate, Factor, Pose, is_pose
from ..measurement import Array
from ..space import Space
from ..variables import estimate_in, is_point, is_posed, largest
from .salvage import salvaged

SETTLED = 1e-10  # largest change of a variable (m, rad) at which a rebuild is done
ROUNDING = 1e-10  # relative change of the cost at which a step that no longer shrinks is only rounding
ROUNDS = 30  # of re-linearization in a rebuild
AFLOAT = 1e14  # m^2 or rad^2; of a variable that nothing holds, rounding leaves some 1e28
JOINING = frozenset({"loop", "pose"})  # kinds of factors after which one update is not enough

_Failures = (
    Exception  # gtsam throws RuntimeError, IndexError, ValueError; a factor written in Python anything
)

Built = tuple[gtsam.ISAM2, dict[str, int]]  # and factor id -> iSAM2's index of it


class Unsettled(
    RuntimeError
):  # never leaves this file: finite, but it moves on and on (a kernel between two minima)
    pass


class Isam2:
    name = "isam2"

    def __init__(self, config: Config, space: Space) -> None:
        self._config, self._space = config.isam2, space
        self._qr = config.isam2.factorization == "qr"
        self.factors: dict[str, Factor] = {}
        self._slots: dict[str, int] = {}  # factor id -> iSAM2's index of it
        self._incidents: list[Decision] = []
        self._isam = self._empty()
        self._guesses: dict[int, Any] = {}  # of every variable: where to start when all else is lost
        self._believed = Believed(self)
        self._force = gtsam.ISAM2UpdateParams()
        self._force.force_relinearize = True

    def update(self, delta: Delta) -> Estimate:
        if not self.factors.keys() >= set(delta.remove):  # what had to be let go of before is gone already
            delta = replace(delta, remove=tuple(id_ for id_ in delta.remove if id_ in self.factors))
        fresh = [key for key in delta.values if not self._isam.valueExists(key)]
        self._believed.forget()
        try:
            if len(fresh) < len(delta.values):
                self._move(delta)  # variables that exist are moved: iSAM2 cannot do that
            else:
                self._apply(delta)
            self._check(delta)
        except _Failures as error:
            self._believed.forget()
            self._recover(delta, fresh, error)
        self._commit(delta)
        return self._believed

    def polish(self) -> Estimate:
        values = self._isam.calculateBestEstimate()
        if values.size():
            try:
                self._isam, self._slots = self._settled(self.factors.values(), values)
            except _Failures as error:
                self._note("unpolished", error, 0)
        self._believed.forget()
        return self._believed

    def restart(self, factors: Iterable[Factor], values: gtsam.Values) -> Estimate:
        held, qr = {factor.id: factor for factor in factors}, self._qr
        gone = [factor for id_, factor in self.factors.items() if held.get(id_) is not factor]
        try:
            isam, slots = self._climb(list(held.values()), values)
            _check_held(isam, (key for factor in gone for key in factor.keys if isam.valueExists(key)))
        except _Failures as error:
            self._qr = qr
            raise SolverFailure(_short(error), ()) from None
        self._isam, self._slots = isam, slots
        self._believed.forget()
        self.factors.clear()  # others hold on to the store itself
        self.factors.update(held)
        return self._believed

    def incidents(self) -> tuple[Decision, ...]:
        told, self._incidents = tuple(self._incidents), []
        return told

    def _apply(self, delta: Delta) -> None:
        graph, values = _graph(delta.add), _values(delta.values)
        first = self._isam.getFactorsUnsafe().size()
        params = gtsam.ISAM2UpdateParams()
        if delta.remove:
            params.removeFactorIndices = [self._slots[id_] for id_ in delta.remove]
        kinds = {factor.kind for factor in delta.add}
        # a pixel is less linear than all else: what is off its point of linearization now is an outlier at the next frame
        params.force_relinearize = "pixel" in kinds
        self._isam.update(graph, values, params)
        self._slots.update(zip((factor.id for factor in delta.add), count(first)))
        if kinds & JOINING:
            for _ in range(self._config.extra_updates):
                result = self._isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), self._force)
                if result.getVariablesRelinearized() == 0:
                    break

    def _check(self, delta: Delta) -> None:
        """Garbage without a throw: what the change adds or joins must be finite, and on this planet."""
        joined = (key for factor in delta.add if factor.kind in JOINING for key in factor.keys)
        astray = self._astray({**delta.values, **dict.fromkeys(joined)})
        if astray is not None:
            raise RuntimeError(
                f"estimate is not finite, or leaves the world, near variable {gtsam.DefaultKeyFormatter(astray)}"
            )
        _check_held(self._isam, self._released(delta))

    def _astray(self, keys: Iterable[int]) -> int | None:
        """The first of some variables that is not finite, or not on this planet; points, of which a camera makes hundreds, at once."""
        points, others = list[int](), list[int]()
        for key in keys:
            (points if is_point(key) else others).append(key)
        if points:
            within = np.abs([self._believed.point(key) for key in points]).max(axis=1) < FARTHEST
            if not within.all():
                return points[int(within.argmin())]
        return next(
            (key for key in others if not largest(self._space, key, self._believed.value(key)) < FARTHEST),
            None,
        )

    def _released(self, delta: Delta) -> set[int]:
        """What removed factors held, and others must hold now.

        Not asked of pixels: hundreds of others hold such a pose, and a point that loses all of its sightings goes with them.
        """
        gone = [self.factors[id_] for id_ in _gone(delta)]
        return {key for factor in gone if factor.kind != "pixel" for key in factor.keys}

    def _commit(self, delta: Delta) -> None:
        released = {key for id_ in delta.remove for key in self.factors[id_].keys}
        for id_ in _gone(delta):
            self._slots.pop(id_, None)
            self.factors.pop(id_, None)
        for key in released:
            if not self._isam.valueExists(key):
                self._guesses.pop(key, None)
        self.factors.update((factor.id, factor) for factor in delta.add)
        self._guesses.update(delta.values)

    def _move(self, delta: Delta) -> None:
        values = self._isam.calculateBestEstimate()
        for key, value in delta.values.items():
            values.insert_or_assign(key, value)
        self._isam, self._slots = self._settled(self._after(delta), values)

    def _recover(self, delta: Delta, fresh: Sequence[int], error: Exception) -> None:
        """Rebuild with the change, on a stronger rung; or without it, and say which factors are guilty."""
        before, qr = self._refuge(fresh), self._qr
        values = gtsam.Values(before)
        for key, value in delta.values.items():
            values.insert_or_assign(key, value)
        guilty = tuple(factor.id for factor in delta.add if not _linearizes(factor, values))
        if not guilty:
            self._qr = qr or self._config.factorization == "auto"
            try:
                self._isam, self._slots = self._climb(list(self._after(delta)), values)
                _check_held(self._isam, self._released(delta))
            except _Failures:
                guilty = self._unsolvable(delta, before)
            else:
                self._note("rebuilt", error, _stamp(delta))
                return
        self._qr = qr
        try:
            self._isam, self._slots = self._climb(list(self.factors.values()), before)
        except _Failures:
            self._salvage(before, _stamp(delta))
        without = guilty or tuple(f"removing {id_}" for id_ in delta.remove)
        self._note("rolled_back", error, _stamp(delta), f"; without {', '.join(without)}")
        raise SolverFailure(_short(error), guilty) from None

    def _salvage(self, before: gtsam.Values, stamp: int) -> None:
        """Not even what has been solved before can be solved again: go on with less."""

        def solve(factors: Sequence[Factor], values: gtsam.Values) -> gtsam.Values | None:
            try:
                self._isam, self._slots = self._climb(factors, values)
            except _Failures:
                return None
            return self._isam.calculateBestEstimate()

        self._qr = True
        kept, values = salvaged(self.factors.values(), (before, _values(self._guesses)), self._space, solve)
        self._isam, self._slots = self._built(kept, values)
        held = {factor.id: factor for factor in kept}
        gone = [factor for factor in self.factors.values() if factor.id not in held]
        self.factors.clear()  # others hold on to the store itself
        self.factors.update(held)
        self._guesses = {key: guess for key, guess in self._guesses.items() if values.exists(key)}
        self._incidents += [_withdrawn(factor, stamp) for factor in gone]

    def _refuge(self, fresh: Iterable[int]) -> gtsam.Values:
        """Where to start a rebuild: iSAM2's linearization point without new variables; first guesses if that is lost."""
        values = gtsam.Values(self._isam.getLinearizationPoint())
        for key in fresh:
            if values.exists(key):
                values.erase(key)
        if values.size() and not np.isfinite(values.localCoordinates(values).vector()).all():
            return _values(self._guesses)
        for key, guess in self._guesses.items():
            if not values.exists(key):  # iSAM2 forgets a variable with its last factor
                values.insert(key, guess)
        return values

    def _after(self, delta: Delta) -> Iterable[Factor]:
        gone = set(delta.remove)
        yield from (factor for factor in self.factors.values() if factor.id not in gone)
        yield from delta.add

    def _climb(self, factors: Sequence[Factor], values: gtsam.Values) -> Built:
        """Gauss-Newton, with QR if it must be; then batch Levenberg-Marquardt and whatever is near its optimum. Raises what
        the last rung raised.
        """
        for qr in dict.fromkeys((self._qr, True)):
            self._qr = qr
            try:
                return self._settled(factors, values)
            except _Failures:
                continue
        params = gtsam.LevenbergMarquardtParams()
        found = gtsam.LevenbergMarquardtOptimizer(_graph(factors), values, params).optimize()
        try:
            return self._settled(factors, found)
        except Unsettled:
            return self._built(factors, found)

    def _settled(self, factors: Iterable[Factor], values: gtsam.Values) -> Built:
        """A new ISAM2 with fresh linearization points, renewed until the largest step is below SETTLED."""
        factors = list(factors)
        graph, error, last = _graph(factors), np.inf, np.inf
        for _ in range(ROUNDS if factors else 0):
            isam, slots = self._built(factors, values)
            found = isam.calculateBestEstimate()
            step = float(np.abs(values.localCoordinates(found).vector()).max())
            now = graph.error(found)
            if not (step < FARTHEST and isfinite(now)):
                raise RuntimeError("the rebuilt estimate is not finite, or leaves the world")
            values = found
            if step < SETTLED or (step >= last and abs(error - now) <= ROUNDING * now):
                return isam, slots
            error, last = now, step
        if not factors:
            return self._empty(), {}
        raise Unsettled("the rebuilt estimate does not settle")

    def _built(self, factors: Sequence[Factor], values: gtsam.Values) -> Built:
        isam = self._empty()
        isam.update(_graph(factors), values)
        return isam, {factor.id: i for i, factor in enumerate(factors)}

    def _unsolvable(self, delta: Delta, before: gtsam.Values) -> tuple[str, ...]:
        """Factors of the change that cannot be solved one after the other, motion first."""
        kept, values, guilty = list(self.factors.values()), gtsam.Values(before), []
        sure = [[factor] for factor in delta.add if factor.kind in ("gauge", "motion")]
        groups = deque([*sure, [factor for factor in delta.add if factor.kind not in ("gauge", "motion")]])
        while groups:  # halves of what fails: a camera adds hundreds at once
            group = groups.popleft()
            trial = gtsam.Values(values)
            for key in (key for factor in group for key in factor.keys):
                if not trial.exists(key) and key in delta.values:
                    trial.insert(key, delta.values[key])
            try:
                self._settled([*kept, *group], trial)
            except _Failures:
                if len(group) == 1:
                    guilty.append(group[0].id)
                else:
                    groups.extendleft((group[len(group) // 2 :], group[: len(group) // 2]))
            else:
                kept += group
                values = trial
        return tuple(guilty) or tuple(factor.id for factor in delta.add)

    def _note(self, reason: str, error: Exception, stamp: int, more: str = "") -> None:
        self._incidents.append(
            Decision(stamp, f"solver/{reason}", "solver", "restored", "solver", reason, _short(error) + more)
        )

    def _empty(self) -> gtsam.ISAM2:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(self._config.relinearize_threshold)
        params.relinearizeSkip = self._config.relinearize_skip
        params.enablePartialRelinearizationCheck = True
        # gtsam's own default of 1e-3 leaves each of thousands of poses a fraction of a millimetre behind, which
        # against odometry of 2 mm per step is a cost of 1.2 times the optimum
        descent = gtsam.ISAM2GaussNewtonParams()
        descent.setWildfireThreshold(self._config.wildfire_threshold)
        params.setOptimizationParams(descent)
        params.setFactorization("QR" if self._qr else "CHOLESKY")
        return gtsam.ISAM2(params)


class Believed:
    """What an Isam2 believes at the moment of asking, failures survived. Implements graph.Estimate."""

    def __init__(self, solver: Isam2) -> None:
        self._solver = solver
        self._poses: dict[int, Pose] = {}  # asked for since the last update: of the newest several times

    def forget(self) -> None:
        """The solver believes something else now."""
        self._poses.clear()

    @property
    def _isam(self) -> gtsam.ISAM2:
        return self._solver._isam  # noqa: SLF001  # one thing in two classes

    def pose(self, key: int) -> Pose:
        found = self._poses.get(key)
        if found is None:
            found = self._poses[key] = self._solver._space.estimate(self._isam, key)  # noqa: SLF001
        return found

    def point(self, key: int) -> Array:
        return self._solver._space.estimate_point(self._isam, key)  # noqa: SLF001

    def value(self, key: int) -> Any:
        if is_posed(key):
            return self.pose(key)
        return estimate_in(self._solver._space, self._isam, key)  # noqa: SLF001

    def knows(self, key: int) -> bool:
        return bool(self._isam.valueExists(key))

    def values(self) -> gtsam.Values:
        """A whole back-substitution, without wildfire threshold. Of a copy: iSAM2 keeps the steps that it computes, and when it
        linearizes next depends on them, so that to look would change what follows.
        """
        return gtsam.ISAM2(self._isam).calculateBestEstimate()

    def covariance(self, keys: Sequence[int]) -> Array:
        try:
            if len(keys) == 1:
                return np.asarray(self._isam.marginalCovariance(keys[0]))
            return np.asarray(self._isam.jointMarginalCovariance(list(keys)).fullMatrix())
        except _Failures as error:
            raise SolverFailure(_short(error), ()) from None


def _gone(delta: Delta) -> set[str]:
    """What is removed, and not put back with other numbers."""
    return set(delta.remove) - {factor.id for factor in delta.add}


def _check_held(isam: gtsam.ISAM2, keys: Iterable[int]) -> None:
    """What a removed factor held must be held by others: rounding can hide from both factorizations that it is not."""
    for key in set(keys):
        if not isam.valueExists(key) and not is_pose(key):
            continue  # it left with its last factor, as a landmark may
        if not np.diag(isam.marginalCovariance(key)).max() < AFLOAT:
            raise RuntimeError(f"nothing holds variable {gtsam.DefaultKeyFormatter(key)}")


def _graph(factors: Iterable[Factor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor.factor)
    return graph


def _values(guesses: Mapping[int, Any]) -> gtsam.Values:
    values = gtsam.Values()
    for key, value in guesses.items():
        values.insert(key, value)
    return values


def _withdrawn(factor: Factor, stamp: int) -> Decision:
    return Decision(
        stamp, factor.id, factor.source, "removed", "solver", "withdrawn",
        "the graph could not be solved any more, and can be without it", ends=factor.stamps,
    )  # fmt: skip


def _stamp(delta: Delta) -> int:
    return max((factor.stamp for factor in delta.add), default=0)


def _linearizes(factor: Factor, values: gtsam.Values) -> bool:
    try:
        matrix, rhs = factor.factor.linearize(values).jacobian()
    except _Failures:
        return False
    return bool(np.isfinite(matrix).all() and np.isfinite(rhs).all())


def _short(error: Exception) -> str:
    """First sentence of gtsam's text, which may run to pages."""
    return " ".join(str(error).split())[:160]
