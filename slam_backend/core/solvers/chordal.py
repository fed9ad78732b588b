"""Rotations first: the chordal relaxation (Martinec & Pajdla, CVPR 2007; Carlone et al., ICRA 2015), in 2-D and 3-D.

Without the constraint that they are rotations, the R of `R_j = R_i R_ij` solve a linear least-squares problem, row by row:
with the rows as unknowns of d numbers each, one elimination per row. The nearest rotations to what comes out do not
depend on any start, so no drift can have wound them the wrong way round. The translations that fit them
best are linear, too.
"""

import gtsam
import numpy as np

from ..measurement import Array
from .edges import Edges
from .gauges import Labels

SPREAD = 1e3  # weights of rotations stay within this factor of their median,
CAP = 1e4  # and the information of translations below this multiple of its own: enough for a start, and well-posed


def chordal(edges: Edges, roots: Labels, count: int) -> tuple[Array, Array]:
    """(N, d, d) rotations and (N, d) translations of the N rows; the roots, one for each part, are the origin.

    Rows that no edge touches (landmarks) are at the origin, too.
    """
    rotations = _rotations(edges, roots, count)
    return rotations, _translations(edges, rotations, roots)


def _rotations(edges: Edges, roots: Labels, count: int) -> Array:
    d = edges.matrices.shape[-1] - 1
    weight = _weights(edges)
    back = -weight[:, None, None] * edges.matrices[:, :d, :d].swapaxes(1, 2)  # row_j = R_ij^T row_i
    there = weight[:, None, None] * np.eye(d)
    right = np.zeros((len(weight), d))
    linear = _linear(edges, back, there, right)
    rows = np.zeros((count, d, d))
    for k in range(d):
        rows[:, k] = _solved(linear, roots, np.eye(d)[k], float(np.median(weight)), count)
    left, _, right = np.linalg.svd(rows)
    left[:, :, -1] *= np.sign(np.linalg.det(left @ right))[:, None]
    rotations = left @ right
    rotations[~rows.any(axis=(1, 2))] = np.eye(d)
    return np.asarray(rotations)


def _weights(edges: Edges) -> Array:
    """(M,) one over the standard deviation of each rotation."""
    axes = _axes(edges)[0]
    precision = np.diagonal(edges.information, axis1=1, axis2=2)[:, axes].mean(axis=1)
    middle = np.median(precision)
    if not middle > 0:
        return np.ones(len(precision))
    return np.asarray(np.sqrt(np.clip(precision, middle / SPREAD**2, middle * SPREAD**2)))


def _translations(edges: Edges, rotations: Array, roots: Labels) -> Array:
    """Those that minimize chi2 with the rotations held, to first order in the error of the rotations."""
    d = rotations.shape[-1]
    rotation, translation = _axes(edges)
    measured = edges.matrices[:, :d, :d]
    turned = rotations[edges.i] @ measured  # of j, as seen from i
    error = _small(turned.swapaxes(1, 2) @ rotations[edges.j])
    root = _square_root(edges.information)
    there = root[:, :, translation] @ turned.swapaxes(1, 2)
    along = np.einsum("mji,mj->mi", measured, edges.matrices[:, :d, d])
    right = np.einsum("mij,mj->mi", root[:, :, translation], along)
    right -= np.einsum("mij,mj->mi", root[:, :, rotation], error)
    weight = float(np.median(np.abs(root).max(axis=(1, 2))))
    return _solved(_linear(edges, -there, there, right), roots, np.zeros(d), weight, len(rotations))


def _axes(edges: Edges) -> tuple[slice, slice]:
    """Those of rotation and of translation in the tangent."""
    return (slice(2, 3), slice(0, 2)) if edges.space.name == "2d" else (slice(0, 3), slice(3, 6))


def _small(rotations: Array) -> Array:
    """Sine of the angle times the axis: (M, d, d) to (M, 1 or 3)."""
    skew = (rotations - rotations.swapaxes(1, 2)) / 2
    if skew.shape[-1] == 2:
        return skew[:, 1, :1]
    return np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)


def _square_root(information: Array) -> Array:
    """S with S^T S = information, its largest eigenvalues capped."""
    values, vectors = np.linalg.eigh(information)
    values = np.clip(values, 0, CAP * np.median(values))
    return np.asarray(np.sqrt(values)[:, :, None] * vectors.swapaxes(1, 2))


def _linear(edges: Edges, at_i: Array, at_j: Array, right: Array) -> gtsam.GaussianFactorGraph:
    linear = gtsam.GaussianFactorGraph()
    noise = gtsam.noiseModel.Unit.Create(right.shape[1])
    for i, j, a, b, c in zip(edges.i.tolist(), edges.j.tolist(), at_i, at_j, right, strict=True):
        linear.add(i, a, j, b, c, noise)
    return linear


def _solved(
    linear: gtsam.GaussianFactorGraph, roots: Labels, value: Array, weight: float, count: int
) -> Array:
    """(N, d) with the roots held at the value."""
    held, d = gtsam.GaussianFactorGraph(), len(value)
    held.push_back(linear)
    noise = gtsam.noiseModel.Unit.Create(d)
    for root in roots.tolist():
        held.add(root, weight * np.eye(d), weight * value, noise)
    try:
        found = held.optimize()
    except RuntimeError:  # scales that Cholesky cannot take
        found = held.optimize(gtsam.EliminateQR)
    rows = np.zeros((count, d))
    for key in held.keyVector():
        rows[key] = found.at(key)
    return rows
