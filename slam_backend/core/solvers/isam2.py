"""iSAM2 that survives: incremental smoothing over the whole trajectory (Kaess et al., IJRR 2012).

After gtsam.ISAM2 throws, its state is poisoned: the next update silently "works" and answers garbage. So the factors
are stored here, and after any failure the ISAM2 is dropped and rebuilt from them, rung by rung:

    QR from the last linearization point, re-linearized until nothing moves
    batch Levenberg-Marquardt, then QR from its optimum
    the same without the factors of the change that cannot be solved: SolverFailure names them

Cholesky is about twice as fast as QR on graphs rich in loops, but throws on long open trajectories and on
strongly anisotropic information; once it has thrown, QR serves for the rest of the run.
"""

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from ..config import Config
from ..errors import SolverFailure
from ..graph import Decision, Delta, Estimate, Factor, Pose
from ..measurement import Array
from ..space import Space

SETTLED = 1e-9  # largest change of a variable (m, rad) at which a rebuild is done
ROUNDING = 1e-10  # relative change of the cost that is only the rounding of the normal equations
ROUNDS = 30  # of re-linearization in a rebuild
JOINING = frozenset({"loop", "pose"})  # kinds of factors after which one update is not enough

_Failures = (
    RuntimeError,
    IndexError,
    ValueError,
)  # what gtsam throws: indeterminate systems, missing keys, bad noise


class Isam2:
    def __init__(self, config: Config, space: Space) -> None:
        self._config, self._space = config.isam2, space
        self._qr = config.isam2.factorization == "qr"
        self.factors: dict[str, Factor] = {}
        self._slots: dict[str, int] = {}  # factor id -> iSAM2's index of it
        self._incidents: list[Decision] = []
        self._isam = self._empty()
        self._force = gtsam.ISAM2UpdateParams()
        self._force.force_relinearize = True

    def update(self, delta: Delta) -> Estimate:
        if any(self._isam.valueExists(key) for key in delta.values):
            return self._rebuild(delta)  # variables that exist are moved: iSAM2 cannot do that
        try:
            self._apply(delta)
            self._check(delta)
        except _Failures as error:
            return self._recover(delta, error)
        self._commit(delta)
        return Believed(self._isam, self._space)

    def polish(self) -> Estimate:
        values = self._isam.calculateBestEstimate()
        if values.size():
            isam, slots = self._settled(self.factors.values(), values)
            self._isam, self._slots = isam, slots
        return Believed(self._isam, self._space)

    def incidents(self) -> tuple[Decision, ...]:
        told, self._incidents = tuple(self._incidents), []
        return told

    def _apply(self, delta: Delta) -> None:
        graph, values = _gather(delta.add, delta.values)
        first = self._isam.getFactorsUnsafe().size()
        if delta.remove:
            self._isam.update(graph, values, [self._slots[id_] for id_ in delta.remove])
        else:
            self._isam.update(graph, values)
        for i, factor in enumerate(delta.add):
            self._slots[factor.id] = first + i
        if any(factor.kind in JOINING for factor in delta.add):
            for _ in range(self._config.extra_updates):
                result = self._isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), self._force)
                if result.getVariablesRelinearized() == 0:
                    break

    def _check(self, delta: Delta) -> None:
        """Garbage without a throw: the newest variables of the change must be finite."""
        estimate = Believed(self._isam, self._space)
        for key, value in delta.values.items():
            found = (
                estimate.point(key)
                if isinstance(value, np.ndarray)
                else self._space.numbers(estimate.pose(key))
            )
            if not np.isfinite(found).all():
                raise RuntimeError(f"estimate is not finite near variable {gtsam.DefaultKeyFormatter(key)}")

    def _commit(self, delta: Delta) -> None:
        for id_ in delta.remove:
            del self.factors[id_]
            self._slots.pop(id_, None)
        for factor in delta.add:
            self.factors[factor.id] = factor

    def _rebuild(self, delta: Delta) -> Estimate:
        """Apply a change that moves existing variables."""
        values = self._isam.calculateBestEstimate()
        for key, value in delta.values.items():
            values.insert_or_assign(key, value)
        try:
            self._isam, self._slots = self._settled(self._after(delta), values)
        except _Failures as error:
            return self._recover(delta, error)
        self._commit(delta)
        return Believed(self._isam, self._space)

    def _recover(self, delta: Delta, error: Exception) -> Estimate:
        """Rebuild with the change, on a stronger rung; or without it, and say which factors are guilty."""
        start = _finite(self._isam.getLinearizationPoint(), self._space)
        values = gtsam.Values(start)
        for key, value in delta.values.items():
            values.insert_or_assign(key, value)
        before = gtsam.Values(start)
        for key in delta.values:
            if before.exists(key):
                before.erase(key)
        guilty = self._broken(delta, values)
        if not guilty:
            try:
                self._isam, self._slots = self._climb(list(self._after(delta)), values)
            except _Failures:
                guilty = self._unsolvable(delta, before)
            else:
                self._commit(delta)
                self._note("rebuilt", error, "")
                return Believed(self._isam, self._space)
        self._isam, self._slots = (
            self._climb(list(self.factors.values()), before) if self.factors else (self._empty(), {})
        )
        self._note("rolled_back", error, f"; without {', '.join(guilty)}")
        raise SolverFailure(_short(error), guilty) from None

    def _after(self, delta: Delta) -> Iterable[Factor]:
        gone = set(delta.remove)
        yield from (factor for factor in self.factors.values() if factor.id not in gone)
        yield from delta.add

    def _climb(self, factors: Sequence[Factor], values: gtsam.Values) -> tuple[gtsam.ISAM2, dict[str, int]]:
        """QR; then batch Levenberg-Marquardt and QR from there. Raises what the last rung raised."""
        self._qr = self._qr or self._config.factorization == "auto"
        try:
            return self._settled(factors, values)
        except _Failures:
            graph, start = _gather(factors, {})[0], values
            found = gtsam.LevenbergMarquardtOptimizer(
                graph, start, gtsam.LevenbergMarquardtParams()
            ).optimize()
            return self._settled(factors, found)

    def _settled(self, factors: Iterable[Factor], values: gtsam.Values) -> tuple[gtsam.ISAM2, dict[str, int]]:
        """A new ISAM2 with fresh linearization points, renewed until the largest step is below SETTLED."""
        graph, slots = gtsam.NonlinearFactorGraph(), {}
        for i, factor in enumerate(factors):
            graph.add(factor.factor)
            slots[factor.id] = i
        error = np.inf
        for _ in range(ROUNDS):
            isam = self._empty()
            isam.update(graph, values)
            found = isam.calculateBestEstimate()
            step = float(np.abs(values.localCoordinates(found).vector()).max())
            now = graph.error(found)
            if not (np.isfinite(step) and np.isfinite(now)):
                raise RuntimeError("the rebuilt estimate is not finite")
            values = found
            if step < SETTLED or abs(error - now) <= ROUNDING * now:
                return isam, slots
            error = now
        raise RuntimeError("the rebuilt estimate does not settle")

    def _broken(self, delta: Delta, values: gtsam.Values) -> tuple[str, ...]:
        """Factors of the change that cannot even be linearized to finite numbers."""
        return tuple(factor.id for factor in delta.add if not _linearizes(factor, values))

    def _unsolvable(self, delta: Delta, before: gtsam.Values) -> tuple[str, ...]:
        """Factors of the change that cannot be solved one after the other, motion first."""
        kept, values, guilty = list(self.factors.values()), gtsam.Values(before), []
        for factor in sorted(delta.add, key=lambda factor: factor.kind not in ("gauge", "motion")):
            trial = gtsam.Values(values)
            for key in factor.keys:
                if not trial.exists(key) and key in delta.values:
                    trial.insert(key, delta.values[key])
            try:
                self._settled([*kept, factor], trial)
            except _Failures:
                guilty.append(factor.id)
            else:
                kept.append(factor)
                values = trial
        return tuple(guilty) or tuple(factor.id for factor in delta.add)

    def _note(self, reason: str, error: Exception, more: str) -> None:
        self._incidents.append(
            Decision(0, f"solver/{reason}", "solver", "restored", "solver", reason, _short(error) + more)
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
    """The estimate of one ISAM2; valid until its next update. Implements graph.Estimate."""

    def __init__(self, isam: gtsam.ISAM2, space: Space) -> None:
        self._isam, self._space = isam, space

    def pose(self, key: int) -> Pose:
        return self._space.estimate(self._isam, key)

    def point(self, key: int) -> Array:
        return self._space.estimate_point(self._isam, key)

    def knows(self, key: int) -> bool:
        return bool(self._isam.valueExists(key))

    def values(self) -> gtsam.Values:
        return self._isam.calculateBestEstimate()  # a whole back-substitution: no wildfire threshold

    def covariance(self, keys: Sequence[int]) -> Array:
        try:
            if len(keys) == 1:
                return np.asarray(self._isam.marginalCovariance(keys[0]))
            joint = self._isam.jointMarginalCovariance(list(keys))
        except _Failures as error:
            raise SolverFailure(_short(error), ()) from None
        return np.block([[joint.at(i, j) for j in keys] for i in keys])


def _gather(factors: Iterable[Factor], values: object) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, first = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for factor in factors:
        graph.add(factor.factor)
    assert isinstance(values, dict)
    for key, value in values.items():
        first.insert(key, value)
    return graph, first


def _finite(values: gtsam.Values, space: Space) -> gtsam.Values:
    """A copy; raises SolverFailure when even the linearization point is lost."""
    copy = gtsam.Values(values)
    if copy.size() and not np.isfinite(np.abs(copy.localCoordinates(copy).vector())).all():
        raise SolverFailure(f"the {space.name} linearization point is not finite", ())
    return copy


def _linearizes(factor: Factor, values: gtsam.Values) -> bool:
    try:
        matrix, rhs = factor.factor.linearize(values).jacobian()
    except _Failures:
        return False
    return bool(np.isfinite(matrix).all() and np.isfinite(rhs).all())


def _short(error: Exception) -> str:
    """First sentence of gtsam's text, which may run to pages."""
    return " ".join(str(error).split())[:160]
