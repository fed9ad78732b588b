"""Gauss-Newton in the plane to the last digits.

gtsam's logarithm in SE(2) divides a difference of nearly equal numbers by the angle: an edge that turns by 1e-9 rad
less than measured has an error of 1e-7 m in its residual. Summed along a trajectory, its steps never get below some
1e-6 m. Here the residuals and Jacobians of edges and priors are those of gtsam's factors, written so that nothing
cancels; all other factors, and those with robust kernels, are gtsam's own.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import gtsam
import numpy as np

from ..graph import Factor
from ..measurement import Array
from ..space import SPACES
from ..variables import is_posed

SMALL = 1e-3  # rad; below, the series are exact to the last digit

UNUSUAL = (gtsam.noiseModel.Robust, gtsam.noiseModel.Constrained)


class Measured:
    """(M, 3) x y theta as measured, of one end in the other or (priors, of one end) in the map; with its information."""

    def __init__(self, factors: Sequence[Any], ends: int) -> None:
        self.keys = np.array([factor.keys() for factor in factors], dtype=np.uint64).reshape(-1, ends)
        poses = [factor.measured() if ends == 2 else factor.prior() for factor in factors]
        self.poses = np.array([(pose.x(), pose.y(), pose.theta()) for pose in poses]).reshape(-1, 3)
        # R^T R is the information, which is singular where only a place is measured.
        self._root = np.array([factor.noiseModel().R() for factor in factors]).reshape(-1, 3, 3)

    def linearized(self, found: Array) -> tuple[Array, Array]:
        """(M, 3, 3) Jacobians at the child and (M, 3) right-hand sides, whitened, at (M, 3) poses as found."""
        error = log(between(self.poses, found))
        jacobian = self._root @ inverse_right_jacobian(error)
        return jacobian, -np.einsum("mij,mj->mi", self._root, error)


class Planar:
    """A graph of planar poses, edges between them, and whatever else."""

    def __init__(self, factors: Iterable[Factor]) -> None:
        space = SPACES["2d"]
        kinds: dict[Any, list[Any]] = {space.between: [], space.prior: [], None: []}
        for factor in (each.factor for each in factors):
            exact = type(factor) in kinds and not isinstance(factor.noiseModel(), UNUSUAL)
            kinds[type(factor) if exact else None].append(factor)
        self._edges, self._priors = Measured(kinds[space.between], 2), Measured(kinds[space.prior], 1)
        self._others = kinds[None]

    def step(self, values: gtsam.Values) -> gtsam.Values:
        """The values one step on. RuntimeError if the system is singular."""
        linear = self._linear(values)
        try:
            return values.retract(linear.optimize())
        except RuntimeError:  # scales that Cholesky cannot take
            return values.retract(linear.optimize(gtsam.EliminateQR))

    def _linear(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        keys = np.array([key for key in values.keys() if is_posed(key)], dtype=np.uint64)  # noqa: SIM118  # no mapping
        poses = gtsam.utilities.extractPose2(values)  # in the order of the keys
        linear, noise = gtsam.GaussianFactorGraph(), gtsam.noiseModel.Unit.Create(3)
        i, j = (poses[np.searchsorted(keys, self._edges.keys[:, end])] for end in (0, 1))
        at_j, right = self._edges.linearized(between(i, j))
        at_i = -at_j @ adjoint(between(j, i))
        for (first, second), a, b, c in zip(self._edges.keys.tolist(), at_i, at_j, right, strict=True):
            linear.add(first, a, second, b, c, noise)
        at, right = self._priors.linearized(poses[np.searchsorted(keys, self._priors.keys[:, 0])])
        for (key,), a, c in zip(self._priors.keys.tolist(), at, right, strict=True):
            linear.add(key, a, c, noise)
        for factor in self._others:
            linear.add(factor.linearize(values))
        return linear


def between(i: Array, j: Array) -> Array:
    """(M, 3) `i_T_j` of (M, 3) poses x y theta; the angle within half a turn."""
    angle = (j - i)[:, 2]
    c, s, (x, y) = np.cos(i[:, 2]), np.sin(i[:, 2]), (j - i)[:, :2].T
    return np.stack([c * x + s * y, c * y - s * x, angle - 2 * np.pi * np.round(angle / (2 * np.pi))], axis=1)


def log(poses: Array) -> Array:
    """(M, 3) tangents of (M, 3) poses x y theta."""
    x, y, angle = poses.T
    half = angle / 2
    with np.errstate(invalid="ignore"):
        along = np.where(np.abs(half) < SMALL, 1 - half**2 / 3 - half**4 / 45, half / np.tan(half))
    return np.stack([along * x + half * y, along * y - half * x, angle], axis=1)


def inverse_right_jacobian(tangents: Array) -> Array:
    """(M, 3, 3) derivative of `log(T Exp(d))` by d."""
    ad = np.zeros((len(tangents), 3, 3))
    x, y, angle = tangents.T
    ad[:, 0, 1], ad[:, 0, 2], ad[:, 1, 0], ad[:, 1, 2] = -angle, y, angle, -x
    half = angle / 2
    with np.errstate(invalid="ignore", divide="ignore"):
        curved = np.where(np.abs(half) < SMALL, 1 / 12 + angle**2 / 720, (1 - half / np.tan(half)) / angle**2)
    return np.asarray(np.eye(3) + ad / 2 + curved[:, None, None] * (ad @ ad))


def adjoint(poses: Array) -> Array:
    """(M, 3, 3) by which a tangent at the child becomes one at the parent."""
    x, y, angle = poses.T
    matrices = np.zeros((len(poses), 3, 3))
    matrices[:, 0, 0] = matrices[:, 1, 1] = np.cos(angle)
    matrices[:, 1, 0] = np.sin(angle)
    matrices[:, 0, 1] = -matrices[:, 1, 0]
    matrices[:, 0, 2], matrices[:, 1, 2], matrices[:, 2, 2] = y, -x, 1
    return matrices
