"""The relative poses of a graph as arrays, for what looks at all of them at once."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gtsam
import numpy as np

from ..graph import Factor, Pose
from ..measurement import Array
from ..space import Space
from ..variables import is_posed
from .gauges import Labels, Layout


@dataclass(frozen=True, eq=False)
class Edges:
    """M relative poses between the variables of a layout; d is 2 or 3.

    i, j: (M,) rows of the layout's keys. poses: gtsam's `i_T_j`. motion: (M,) whether it is an odometry edge.
    """

    space: Space
    i: Labels
    j: Labels
    factors: Sequence[Any]  # gtsam's
    poses: Sequence[Pose]
    motion: Sequence[bool]

    @cached_property
    def matrices(self) -> Array:
        """(M, d + 1, d + 1) `i_T_j`."""
        return matrices_of(self.space, self.poses)

    @cached_property
    def information(self) -> Array:
        """(M, D, D) at the tangent of j, in gtsam's order; of the noise inside, where there is a robust kernel."""
        models = [factor.noiseModel() for factor in self.factors]
        return np.array(
            [(model.noise() if hasattr(model, "noise") else model).information() for model in models]
        )


def edges_of(factors: Sequence[Factor], found: Layout, space: Space) -> Edges:
    """Those between poses of the robot; a tag is a landmark."""
    between = [f for f in factors if isinstance(f.factor, space.between) and f.kind != "landmark"]
    ends = found.rows([key for factor in between for key in factor.keys]).reshape(-1, 2)
    return Edges(
        space,
        ends[:, 0],
        ends[:, 1],
        [factor.factor for factor in between],
        [factor.factor.measured() for factor in between],
        [factor.kind == "motion" for factor in between],
    )


def matrices_of(space: Space, poses: Sequence[Pose]) -> Array:
    """(N, d + 1, d + 1) of gtsam's poses."""
    if space.name == "3d":
        return np.array([pose.matrix() for pose in poses]).reshape(-1, 4, 4)
    x, y, theta = np.array([space.numbers(pose) for pose in poses]).reshape(-1, 3).T
    matrices = np.zeros((len(x), 3, 3))
    matrices[:, :2, :2] = _turned(theta)
    matrices[:, 0, 2], matrices[:, 1, 2], matrices[:, 2, 2] = x, y, 1.0
    return matrices


def rotations_of(space: Space, values: gtsam.Values, found: Layout) -> Array:
    """(N, d, d) of the layout's rows; identity for points."""
    keys = np.array([key for key in values.keys() if is_posed(key)], dtype=np.uint64)  # noqa: SIM118  # no mapping
    here = np.flatnonzero(np.isin(found.keys, keys))
    rows = np.searchsorted(keys, found.keys[here])
    rotations = np.tile(np.eye(2 if space.name == "2d" else 3), (len(found.keys), 1, 1))
    if space.name == "3d":
        rotations[here] = gtsam.utilities.extractPose3(values)[rows, :9].reshape(-1, 3, 3)
    else:
        rotations[here] = _turned(gtsam.utilities.extractPose2(values)[rows, 2])
    return rotations


def _turned(angles: Array) -> Array:
    c, s = np.cos(angles), np.sin(angles)
    return np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)


def pose_of_matrix(space: Space, rotation: Array, translation: Array) -> Pose:
    if space.name == "2d":
        return space.pose_of_numbers((*translation, np.arctan2(rotation[1, 0], rotation[0, 0])))
    return space.pose_of_numbers(np.column_stack([rotation, translation]).ravel().tolist())


def turns(edges: Edges, rotations: Array) -> Array:
    """(M,) rad by which each edge disagrees with (N, d, d) rotations of the layout's rows."""
    d = rotations.shape[-1]
    measured = edges.matrices[:, :d, :d]
    found = rotations[edges.i].swapaxes(1, 2) @ rotations[edges.j]
    trace = np.einsum("mij,mij->m", found, measured)  # of measured^T found
    return np.asarray(np.arccos(np.clip((trace - (d - 2)) / 2, -1, 1)))
