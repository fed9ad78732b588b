"""The kept factors, linearized at the final estimate: what covariances and residuals of a finished run are computed from.

graph.g2o cannot say all that they rest on: it has no line for gauges, absolute poses, robust weights and bearings. Here
every factor is its whitened Jacobian and its whitened residual, robust weight included, in a few flat arrays (linearized.npz):

    indices   (N,) of the keyframes, in order of stamp, as in trajectory.tum
    landmarks (L,) their variables, as in landmarks.csv
    ids       (F,) of the factors                kinds    (F,) motion, loop, landmark, pose, gauge
    counts    (F,) variables of each factor      rows     (F,) rows of its Jacobian
    keys      (M,) those variables, all factors  columns  (M,) their dimensions
    numbers   the Jacobians one after the other, row by row
    errors    the residuals one after the other; their squares sum to chi-square
    free      (F,) degrees of freedom of each that the others check (core/consistency.py)
"""

import zlib
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..core.consistency import Fit
from ..core.errors import BadFile, SolverFailure
from ..core.graph import keyframe
from ..core.measurement import Array
from ..core.trajectory import Stamps

ARRAYS = {"indices": "i", "counts": "i", "rows": "i", "keys": "u", "columns": "i", "numbers": "f",
          "errors": "f", "ids": "U", "kinds": "U", "free": "f", "landmarks": "u"}  # fmt: skip
Strings = NDArray[np.str_]
ADDABLE = 3  # variables of a factor that gtsam can make from matrices directly


def write_linearized(path: Path, fit: Fit, indices: Stamps, landmarks: Sequence[int] = ()) -> None:
    """indices: of the keyframes, in order of stamp; landmarks: their variables."""
    keys = [list(each.keys()) for each in fit.linear]
    flat = [key for each in keys for key in each]
    np.savez_compressed(
        path,
        indices=indices,
        landmarks=np.array(landmarks, dtype=np.uint64),
        counts=np.array([len(each) for each in keys], dtype=np.int64),
        rows=fit.rows,
        keys=np.array(flat, dtype=np.uint64),
        columns=np.array([fit.sizes[key] for key in flat], dtype=np.int64),
        numbers=np.concatenate([np.zeros(0), *(jacobian.ravel() for jacobian, _ in fit.systems)]),
        errors=fit.residuals,
        ids=np.array([f.id for f in fit.factors], dtype=np.str_),
        kinds=np.array([f.kind for f in fit.factors], dtype=np.str_),
        free=fit.free,
    )


class Linearized:
    """The linearized factors of a file. BadFile if it is missing or damaged."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with np.load(path) as file:
                arrays = {name: file[name] for name in ARRAYS}
        except OSError as error:
            raise BadFile(f"{path}: cannot be read: {error.strerror or error}") from None
        except (TypeError, ValueError, KeyError, EOFError, BadZipFile, zlib.error) as error:
            raise BadFile(f"{path}: is damaged: {str(error).splitlines()[0]}") from None
        if any(arrays[name].ndim != 1 or arrays[name].dtype.kind != kind for name, kind in ARRAYS.items()):
            raise BadFile(f"{path}: is damaged: its arrays are not those of a run")
        self.indices: Stamps = arrays["indices"]
        self._arrays = arrays

    @property
    def ids(self) -> Strings:
        """(F,) of the factors."""
        return np.asarray(self._arrays["ids"])

    @property
    def kinds(self) -> Strings:
        """(F,) of the factors."""
        return np.asarray(self._arrays["kinds"])

    @cached_property
    def keys(self) -> list[list[int]]:
        """The variables of each factor."""
        self._fits()
        ends = np.cumsum(self._arrays["counts"])
        return [each.tolist() for each in np.split(self._arrays["keys"], ends[:-1])] if len(ends) else []

    @property
    def landmarks(self) -> list[int]:
        """The variables of the landmarks, in the order of landmarks.csv."""
        return list(self._arrays["landmarks"].tolist())

    @property
    def rows(self) -> Stamps:
        """(F,) degrees of freedom that each factor measures."""
        return np.asarray(self._arrays["rows"])

    @cached_property
    def chi_squares(self) -> Array:
        """(F,) of the factors at the final estimate, robust weights included."""
        self._fits()
        ends = np.cumsum(self.rows)
        squares = np.concatenate([[0.0], np.cumsum(self._arrays["errors"] ** 2)])
        return np.asarray(squares[ends] - squares[ends - self.rows])

    def covariance(self, index: int) -> Array:
        """Marginal covariance of a keyframe's pose at its tangent. SolverFailure if the factors do not determine it."""
        try:
            found = np.asarray(self._tree.marginalCovariance(keyframe(index, 0).pose))
        except (RuntimeError, IndexError, ValueError) as error:
            raise SolverFailure(f"keyframe {index}: {' '.join(str(error).split())[:160]}", ()) from None
        if not np.isfinite(found).all():
            raise SolverFailure(f"keyframe {index}: the factors do not determine its pose", ())
        return found

    @property
    def free(self) -> Array:
        """(F,) degrees of freedom of each factor that the others check."""
        self._fits()
        return np.asarray(self._arrays["free"])

    @cached_property
    def _tree(self) -> Any:  # a GaussianBayesTree
        """By QR, which long open trajectories do not break."""
        graph: Any = gtsam.GaussianFactorGraph()
        for terms, rows in self._factors():
            side = np.zeros(rows)
            if len(terms) <= ADDABLE:
                graph.add(*(part for term in terms for part in term), side)
            else:  # a conditional is a factor too, and takes any number of variables
                unit = gtsam.noiseModel.Unit.Create(rows)
                graph.push_back(gtsam.JacobianFactor(gtsam.GaussianConditional(terms, 1, side, unit)))
        return graph.eliminateMultifrontal(function=gtsam.EliminateQR)

    def _factors(self) -> Iterator[tuple[list[tuple[int, Array]], int]]:
        """(variable, its block) of each factor, and the number of rows."""
        self._fits()
        counts, rows, keys, columns, numbers = (self._arrays[name] for name in list(ARRAYS)[1:6])
        ends = np.cumsum(counts)
        at = 0
        keys, columns = keys.tolist(), columns.tolist()
        for end, count, height in zip(ends.tolist(), counts.tolist(), rows.tolist(), strict=True):
            sizes = columns[end - count : end]
            block = numbers[at : at + height * sum(sizes)].reshape(height, -1)
            at += block.size
            right = [*accumulate(sizes)]
            parts = [block[:, stop - size : stop] for size, stop in zip(sizes, right, strict=True)]
            yield list(zip(keys[end - count : end], parts, strict=True)), height

    def _fits(self) -> None:
        counts, rows, keys, columns, numbers, errors, ids, kinds, free = (
            self._arrays[name] for name in list(ARRAYS)[1:10]
        )
        whole = len({len(each) for each in (counts, rows, ids, kinds, free)}) == 1
        whole = whole and counts.sum() == len(keys) == len(columns) and rows.sum() == len(errors)
        if whole and len(counts):
            widths = np.add.reduceat(columns, np.cumsum(counts) - counts)
            whole = bool((counts > 0).all()) and int((widths * rows).sum()) == len(numbers)
        if not whole:
            raise BadFile(f"{self._path}: is damaged: its arrays do not fit together")
