"""A trajectory as arrays: what every trajectory format is read into and written from."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...core.errors import BadFile
from ...core.measurement import Array, frozen
from .blocks import first_bad_quaternion
from .lines import Rows, Stamps


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """stamps: (N,) int64 ns, in the order of the file. sevens: (N, 7) x y z qx qy qz qw of the body, quaternions of
    any length as the file states them. notes: what the reader has to say about the file.
    """

    stamps: Stamps
    sevens: Array
    notes: tuple[str, ...] = ()


def trajectory_of(rows: Rows, stamps: Stamps, sevens: Array, notes: tuple[str, ...] = ()) -> Trajectory:
    """A Trajectory whose rotations are rotations; else BadFile names the line."""
    if (row := first_bad_quaternion(sevens)) is not None:
        raise rows.bad_line(row, "is no rotation: the quaternion's length is zero or absurd", words=8)
    return Trajectory(stamps, frozen(sevens), notes)


def writable(path: Path, trajectory: Trajectory) -> Trajectory:
    """The trajectory, if every number in it can be read back."""
    if not (finite := np.isfinite(trajectory.sevens).all(axis=1)).all():
        raise BadFile(f"{path}: pose {int(finite.argmin())} is not finite and cannot be written")
    return trajectory
