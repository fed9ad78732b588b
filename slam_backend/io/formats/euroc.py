"""EuRoC ground truth: csv of `ns, x, y, z, qw, qx, qy, qz` and further columns (velocity, biases), which are skipped."""

from pathlib import Path

import numpy as np

from .lines import exact, read_rows, write_lines
from .trajectory import Trajectory, trajectory_of, writable

HEADER = (
    "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
)
TO_SEVEN = [0, 1, 2, 4, 5, 6, 3]  # x y z qw qx qy qz to x y z qx qy qz qw


def read(path: Path) -> Trajectory:
    """Stamps are integers of nanoseconds. BadFile names file, line and word."""
    rows = read_rows(path, separator=",")
    width = max(8, len(rows.words[0]))
    rows.expect(width, "ns, x, y, z, qw, qx, qy, qz and as many more as in the first line")
    skipped = (f"{width - 8} further columns skipped",) if width > 8 else ()
    return trajectory_of(rows, rows.nanoseconds(0), rows.floats(1, 8)[:, TO_SEVEN], skipped)


def write(path: Path, trajectory: Trajectory) -> tuple[str, ...]:
    """Every number to the bit."""
    poses = exact(writable(path, trajectory).sevens[:, np.argsort(TO_SEVEN)])
    body = (
        f"{stamp},{pose.replace(' ', ',')}"
        for stamp, pose in zip(trajectory.stamps.tolist(), poses, strict=True)
    )
    write_lines(path, (HEADER, *body))
    return ()
