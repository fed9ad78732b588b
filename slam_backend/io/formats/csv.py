"""Our own csv of a trajectory: a header that says everything, integers of nanoseconds, every number to the bit."""

from pathlib import Path

from .lines import Rows, exact, read_rows, write_lines
from .trajectory import Trajectory, trajectory_of, writable

HEADER = "stamp_ns,x,y,z,qx,qy,qz,qw"


def read(path: Path) -> Trajectory:
    """BadFile names file, line and word; the header must be there."""
    rows = read_rows(path, separator=",")
    if ",".join(rows.words[0]) != HEADER:
        raise rows.bad(0, ",".join(rows.words[0]), f"is not the header '{HEADER}'")
    body = Rows(path, rows.numbers[1:], rows.words[1:]).expect(8, HEADER)
    return trajectory_of(body, body.nanoseconds(0), body.floats(1, 8))


def write(path: Path, trajectory: Trajectory) -> tuple[str, ...]:
    poses = exact(writable(path, trajectory).sevens)
    body = (
        f"{stamp},{pose.replace(' ', ',')}"
        for stamp, pose in zip(trajectory.stamps.tolist(), poses, strict=True)
    )
    write_lines(path, (HEADER, *body))
    return ()
