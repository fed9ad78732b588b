"""TUM trajectories: `stamp tx ty tz qx qy qz qw`, the stamp in decimal seconds."""

from pathlib import Path

from .lines import exact, read_rows, write_lines, written_seconds
from .trajectory import Trajectory, trajectory_of, writable

LAYOUT = "stamp tx ty tz qx qy qz qw"


def read(path: Path) -> Trajectory:
    """Stamps are parsed as decimal text, exact to the nanosecond. BadFile names file, line and word."""
    rows = read_rows(path).expect(8, LAYOUT)
    return trajectory_of(rows, rows.seconds(0), rows.floats(1, 8))


def write(path: Path, trajectory: Trajectory) -> tuple[str, ...]:
    """Nine digits of nanoseconds, every number to the bit."""
    lines = zip(written_seconds(trajectory.stamps), exact(writable(path, trajectory).sevens), strict=True)
    write_lines(path, (f"{stamp} {seven}" for stamp, seven in lines))
    return ()
