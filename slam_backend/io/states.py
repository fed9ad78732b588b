"""velocities.csv of a run with an IMU: stamp, velocity and biases at each keyframe that the IMU reaches.

stamp, vx, vy, vz (m/s, in the map), ax, ay, az (m/s^2), gx, gy, gz (rad/s): biases in the IMU's frame
"""

import csv
from io import StringIO
from pathlib import Path

import numpy as np

from ..core.errors import BadFile
from ..core.measurement import format_stamp, parse_stamp
from ..core.trajectory import States
from .formats.lines import read_text

NAME = "velocities.csv"
HEAD = ("stamp", "vx", "vy", "vz", "ax", "ay", "az", "gx", "gy", "gz")


def write_states(path: Path, states: States) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(HEAD)
        for stamp, row in zip(states.stamps.tolist(), states.numbers.tolist(), strict=True):
            out.writerow([format_stamp(stamp), *map(repr, row)])


def read_states(path: Path) -> States:
    """None of them where there is no file. BadFile if it is damaged."""
    if not path.exists():
        return States()
    reader = csv.reader(StringIO(read_text(path), newline=""))
    try:
        next(reader)
        rows = [(parse_stamp(row[0]), [float(number) for number in row[1:]]) for row in reader]
        numbers = np.array([row for _, row in rows], dtype=np.float64).reshape(-1, len(HEAD) - 1)
        stamps = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    except (csv.Error, ValueError, IndexError, StopIteration):
        raise BadFile(
            f"{path}:{reader.line_num}: is damaged: no stamp and nine numbers; replay again"
        ) from None
    return States(stamps, numbers)
