"""An extended Kalman filter over the same graph changes as the smoother: what a filter would have said.

It is a `Solver`, and so gets the very factors that iSAM2 gets: same firewall, keyframes, mounts, noise and kernels. What
differs is what makes a filter. Each factor is linearized once, at what was believed when it came, and never again. And
the past is forgotten: the state holds the landmarks and the newest `CLONES` keyframes (stochastic cloning, Roumeliotis
and Burdick, ICRA 2002); a keyframe that leaves keeps the pose it had. A measurement that reaches further back (a loop,
a late sighting) cannot be used, and is refused with a decision.

A factor with unknown variables that it determines (motion, a first sighting, an absolute pose) makes them: whitened,
A_k dx_k + A_u dx_u = b + n with unit n gives their mean and covariance. All others of the same change are one correction.
Covariances stand at the tangents of gtsam's variables, poses at the child: x Exp(dx).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..core.config import Config
from ..core.errors import SolverFailure
from ..core.graph import Decision, Delta, Estimate, Factor, Pose, is_pose
from ..core.measurement import Array
from ..core.solvers import SOLVERS, Solver
from ..core.space import Space
from ..core.variables import is_posed, value_in

CLONES = 100  # keyframes in the state: what a filter can pay for at every step
BATCH = 25  # so many more before the oldest are forgotten together: the covariance is copied then
DIFFUSE = 100.0  # m and rad; standard deviation of what nothing has said yet
DETERMINED = 1e-9  # least singular value of a factor, over its largest, that still determines a variable


class Ekf:
    """Implements core.solvers.Solver and, being what it believes, graph.Estimate."""

    name = "ekf"

    def __init__(self, _: Config, space: Space, clones: int = CLONES) -> None:
        self._space, self._clones = space, clones
        self.factors: dict[str, Factor] = {}
        self._state = State(gtsam.Values(), {}, np.zeros((0, 0)))
        self._past: dict[int, tuple[Pose, Array]] = {}  # keyframes that have left: pose, covariance

    def update(self, delta: Delta) -> Estimate:
        state = self._state
        self._check(delta)
        moved = {key: value for key, value in delta.values.items() if self.knows(key)}
        if moved:  # by one measurement, to where it fits
            state = state.moved(
                {k: v for k, v in moved.items() if k in state.columns}, delta.add[0], self._space
            )
            self._past |= {k: (v, self._past[k][1]) for k, v in moved.items() if k in self._past}
        else:
            state = _taken(state, delta.add, delta.values)
        self._state = self._forgetting(state)
        for id_ in delta.remove:
            self.factors.pop(id_, None)
        self.factors.update((factor.id, factor) for factor in delta.add)
        return self

    def polish(self) -> Estimate:
        """A filter does not look back."""
        return self

    def restart(self, factors: Iterable[Factor], values: gtsam.Values) -> Estimate:  # noqa: ARG002
        raise SolverFailure("a filter cannot begin anew from what it has used", ())

    def incidents(self) -> tuple[Decision, ...]:
        return ()

    def _check(self, delta: Delta) -> None:
        """SolverFailure for what only a smoother can do."""
        if any(id_ in self.factors and self.factors[id_].kind != "gauge" for id_ in delta.remove):
            raise SolverFailure("a filter cannot take back what it has used", tuple(f.id for f in delta.add))
        far = tuple(f.id for f in delta.add if any(key in self._past for key in f.keys))
        if far:
            raise SolverFailure(f"older than the newest {self._clones} keyframes that the filter holds", far)

    def _forgetting(self, state: "State") -> "State":
        """Without the oldest keyframes beyond the bound; where they stood is kept."""
        poses = [key for key in state.columns if is_pose(key)]
        if len(poses) <= self._clones + BATCH:
            return state
        gone = poses[: -self._clones]
        for key in gone:
            self._past[key] = (self._space.pose_in(state.values, key), state.covariance([key]))
        return state.without(gone)

    # -- graph.Estimate ----------------------------------------------------------------------------

    def pose(self, key: int) -> Pose:
        past = self._past.get(key)
        return past[0] if past else self._space.pose_in(self._state.values, key)

    def point(self, key: int) -> Array:
        return self._space.point_in(self._state.values, key)

    def value(self, key: int) -> Any:
        return self.pose(key) if is_pose(key) else value_in(self._space, self._state.values, key)

    def knows(self, key: int) -> bool:
        return key in self._state.columns or key in self._past

    def values(self) -> gtsam.Values:
        values = gtsam.Values(self._state.values)
        for key, (pose, _) in self._past.items():
            values.insert(key, pose)
        return values

    def covariance(self, keys: Sequence[int]) -> Array:
        if len(keys) == 1 and keys[0] in self._past:
            return self._past[keys[0]][1]
        if any(key not in self._state.columns for key in keys):
            raise SolverFailure("the filter has forgotten how these variables depend on each other", ())
        return self._state.covariance(keys)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Mean and covariance. columns: key -> where its tangent stands in the covariance, in the order in which they came."""

    values: gtsam.Values
    columns: Mapping[int, slice]
    P: Array

    def at(self, keys: Iterable[int]) -> NDArray[np.int64]:
        spans = [np.arange(self.columns[key].start, self.columns[key].stop) for key in keys]
        return np.concatenate([np.zeros(0, dtype=np.int64), *spans])

    def covariance(self, keys: Sequence[int]) -> Array:
        rows = self.at(keys)
        return self.P[np.ix_(rows, rows)]

    def without(self, keys: Iterable[int]) -> "State":
        columns, values = dict(self.columns), gtsam.Values(self.values)
        for key in keys:
            del columns[key]
            values.erase(key)
        rows = self.at(columns)
        return State(
            values, _stacked({k: s.stop - s.start for k, s in columns.items()}), self.P[np.ix_(rows, rows)]
        )

    def grown(self, guesses: Mapping[int, Any], A: Array, b: Array, known: Sequence[int]) -> "State":
        """New variables at the guesses, corrected by what determines them: A [dx_new, dx_known] = b + n."""
        fresh = _values(guesses)
        sizes = {key: len(fresh.zeroVectors().at(key)) for key in guesses}
        size, before = sum(sizes.values()), len(self.P)
        solved = np.linalg.solve(A[:, :size], np.column_stack([A[:, size:], b, np.eye(size)]))
        gain, step, root = np.split(solved, [A.shape[1] - size, A.shape[1] - size + 1], axis=1)
        P = np.empty((before + size,) * 2)
        P[:before, :before] = self.P
        rows = self.at(known)
        P[before:, :before] = -gain @ self.P[rows]
        P[:before, before:] = P[before:, :before].T
        P[before:, before:] = gain @ self.P[np.ix_(rows, rows)] @ gain.T + root @ root.T
        values = gtsam.Values(self.values)
        values.insert(fresh.retract(_vectors(step[:, 0], _stacked(sizes))))
        widths = {key: span.stop - span.start for key, span in self.columns.items()}
        return State(values, _stacked(widths | sizes), P)

    def corrected(self, A: Array, b: Array, keys: Sequence[int]) -> "State":
        """The Kalman update for A dx = b + n with unit n: x += K b, P -= K A P. LinAlgError when that is not possible."""
        rows = self.at(keys)
        AP = A @ self.P[rows]
        L = np.linalg.cholesky(AP[:, rows] @ A.T + np.eye(len(b)))
        half, innovation = np.linalg.solve(L, AP), np.linalg.solve(L, b)
        step = half.T @ innovation
        if not np.isfinite(step).all():
            raise np.linalg.LinAlgError("the correction is not finite")
        return State(self.values.retract(_vectors(step, self.columns)), self.columns, self.P - half.T @ half)

    def moved(self, values: Mapping[int, Any], event: Factor, space: Space) -> "State":
        """A part that stood free goes as a whole to where one measurement has it. What held it before is forgotten; within
        the part all is known as well as it was, and where it stands as well as the measurement says.
        """
        believed, J, M = (
            gtsam.Values(self.values),
            np.zeros((len(self.P), space.dimension)),
            np.eye(len(self.P)),
        )
        some = next(key for key in values if is_pose(key))
        turn = values[some].compose(space.pose_in(believed, some).inverse()).rotation().matrix()
        for key, value in values.items():
            span = self.columns[key]
            believed.update(key, value)
            J[span] = value.inverse().AdjointMap() if is_posed(key) else _by_pose(space, value)
            if not is_posed(key):
                M[span, span] = turn  # the tangent of a point has the axes of the map
        here = next(key for key in event.keys if key in values)
        others = [key for key in event.keys if key not in values]
        A, _ = _linearized([event], believed, {}, [here, *others])
        size = space.dimension
        C = J @ np.linalg.inv(J[self.columns[here]])  # where all of it is by where the pose `here` is
        root = np.linalg.inv(A[:, :size])
        M = M - C @ M[self.at([here])]
        M[:, self.at(others)] -= C @ root @ A[:, size:]
        return State(believed, self.columns, M @ self.P @ M.T + C @ root @ root.T @ C.T)


def _taken(state: State, factors: Sequence[Factor], guesses: Mapping[int, Any]) -> State:
    """The state after a change: first the variables that single factors determine, then all the rest at once."""
    rest, unknown = list(factors), dict(guesses)
    while unknown:
        for factor in rest:
            new = [key for key in factor.keys if key in unknown]
            known = [key for key in factor.keys if key in state.columns]
            if new and len(new) + len(known) == len(factor.keys):
                here = {key: unknown[key] for key in new}
                A, b = _linearized([factor], state.values, here, [*new, *known])
                if _determines(A, A.shape[1] - sum(len(state.at([key])) for key in known)):
                    state = state.grown(here, A, b, known)
                    rest.remove(factor)
                    break
        else:  # what is left takes several factors to determine
            key = next(iter(unknown))
            here = {key: unknown[key]}
            size = len(_values(here).zeroVectors().at(key))
            state = state.grown(here, np.eye(size) / DIFFUSE, np.zeros(size), ())
        for key in here:
            del unknown[key]
    return _corrected(state, rest)


def _corrected(state: State, factors: Sequence[Factor]) -> State:
    if not factors:
        return state
    keys = list(dict.fromkeys(key for factor in factors for key in factor.keys))
    A, b = _linearized(factors, state.values, {}, keys)
    try:
        return state.corrected(A, b, keys)
    except np.linalg.LinAlgError as error:
        raise SolverFailure(f"the filter cannot take it: {error}", tuple(f.id for f in factors)) from None


def _linearized(
    factors: Sequence[Factor], known: gtsam.Values, guesses: Mapping[int, Any], keys: Sequence[int]
) -> tuple[Array, Array]:
    """Whitened A (rows, columns in the order of `keys`) and b, kernels as weights; an inactive factor has no rows."""
    values = gtsam.Values(known)
    values.insert(_values(guesses))
    sizes = values.zeroVectors()
    columns = _stacked({key: len(sizes.at(key)) for key in keys})
    width = sum(span.stop - span.start for span in columns.values())
    rows: list[Array] = [np.zeros((0, width + 1))]
    for factor in factors:
        linear = factor.factor.linearize(values)
        if linear is None:
            continue
        A, b = linear.jacobian()
        spans = [columns[key] for key in tuple(linear.keys())]
        order = np.concatenate([np.arange(span.start, span.stop) for span in spans])
        block = np.zeros((len(b), width + 1))
        block[:, order], block[:, -1] = A, b
        rows.append(block)
    stacked = np.vstack(rows)
    return stacked[:, :-1], stacked[:, -1]


def _determines(A: Array, size: int) -> bool:
    """Whether the first `size` columns have an inverse."""
    if A.shape[0] != size:
        return False
    sigmas = np.linalg.svd(A[:, :size], compute_uv=False)
    return bool(sigmas[-1] > DETERMINED * sigmas[0])


def _by_pose(space: Space, point: Array) -> Array:
    """(point, pose) derivative of T p by T at the identity."""
    derivative = np.zeros((space.point_dimension, space.dimension), order="F")
    space.identity.transformFrom(point, derivative, np.zeros((space.point_dimension,) * 2, order="F"))
    return derivative


def _stacked(sizes: Mapping[int, int]) -> dict[int, slice]:
    """One after the other."""
    ends = np.cumsum([0, *sizes.values()]).tolist()
    return {key: slice(ends[n], ends[n + 1]) for n, key in enumerate(sizes)}


def _vectors(step: Array, columns: Mapping[int, slice]) -> gtsam.VectorValues:
    vectors = gtsam.VectorValues()
    for key, span in columns.items():
        vectors.insert(key, step[span])
    return vectors


def _values(guesses: Mapping[int, Any]) -> gtsam.Values:
    values = gtsam.Values()
    for key, value in guesses.items():
        values.insert(key, value)
    return values


ESTIMATORS: Mapping[str, Callable[[Config, Space], Solver]] = {**SOLVERS, "ekf": Ekf}
