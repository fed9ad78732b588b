"""Text files inside gtsam's wheel, and what rows of numbers mean as poses and covariances."""

from pathlib import Path
from typing import NamedTuple

import gtsam
import numpy as np

from ..core.errors import BadFile
from ..core.measurement import Array
from ..io.formats.trajectory import Trajectory
from ..io.records import Record

PLANE = np.array([3, 4, 2])  # x, y, yaw in GTSAM's tangent w, v


class Content(NamedTuple):
    """Records in any order; truth where the data set tells it."""

    records: list[Record]
    truth: Trajectory | None = None


def pose(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array((x, y, z)))


def planar(x: float, y: float, yaw: float) -> gtsam.Pose3:
    return pose(x, y, 0.0, 0.0, 0.0, yaw)


def symmetric(triangles: Array) -> Array:
    """(N, 3) or (N, 6) upper triangles, row by row, to (N, 2, 2) or (N, 3, 3)."""
    size = 2 if triangles.shape[1] == 3 else 3
    rows, columns = np.triu_indices(size)
    matrices = np.zeros((len(triangles), size, size))
    matrices[:, rows, columns] = matrices[:, columns, rows] = triangles
    return matrices


def lifted(covariances: Array) -> Array:
    """(..., 3, 3) of x, y, yaw to (..., 6, 6) in GTSAM's order; z as y, roll and pitch as yaw."""
    lifted = np.zeros((*covariances.shape[:-2], 6, 6))
    lifted[..., PLANE[:, None], PLANE] = covariances
    lifted[..., 5, 5] = covariances[..., 1, 1]
    lifted[..., 0, 0] = lifted[..., 1, 1] = covariances[..., 2, 2]
    return lifted


def rows(name: str) -> list[list[str]]:
    """The words of each line that has any. BadFile if this gtsam comes without the file."""
    return [line.split() for line in example(name).read_text().splitlines() if line.strip()]


def example(name: str) -> Path:
    """BadFile if this gtsam comes without the file."""
    try:
        return Path(gtsam.findExampleDataFile(name))  # type: ignore[no-untyped-call]  # gtsam leaves it untyped
    except (FileNotFoundError, RuntimeError):
        raise BadFile(f"{name}: not among gtsam's examples; install the wheel of gtsam 4.3") from None
