"""KITTI odometry poses: the first three rows of a 4x4 matrix per line, no stamps."""

from pathlib import Path

import numpy as np

from ...core.geometry import matrix_of, seven_of_matrix
from ...core.measurement import SECOND
from .lines import exact, read_rows, write_lines
from .trajectory import Trajectory, trajectory_of, writable

FRAME = SECOND // 10  # the cameras of KITTI run at 10 Hz
ROUNDING = 1e-2  # how far from orthonormal the decimals of a file may leave a rotation


def read(path: Path) -> Trajectory:
    """Frame k has the stamp k times 0.1 s; the notes say so. BadFile names file, line and word."""
    rows = read_rows(path).expect(12, "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz")
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    matrices[:, :3] = rows.floats(0, 12).reshape(-1, 3, 4)
    R = matrices[:, :3, :3]
    with np.errstate(all="ignore"):
        gram = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
        bad = ~((gram < ROUNDING) & (np.linalg.det(R) > 0))
    if bad.any():
        raise rows.bad_line(int(bad.argmax()), "is no rotation: the matrix is not orthonormal", words=4)
    stamps = np.arange(len(rows), dtype=np.int64) * FRAME
    note = "KITTI files have no stamps: frame k has k times 0.1 s"
    return trajectory_of(rows, stamps, seven_of_matrix(matrices), (note,))


def write(path: Path, trajectory: Trajectory) -> tuple[str, ...]:
    """Twelve numbers per pose; the stamps are left out."""
    matrices = matrix_of(writable(path, trajectory).sevens)
    write_lines(path, exact(matrices[:, :3].reshape(-1, 12)))
    return ("stamps",)
