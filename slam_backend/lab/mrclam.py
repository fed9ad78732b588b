"""MRCLAM: five robots among fifteen landmarks, Vicon truth (Leung et al., IJRR 30(8), 2011).

A folder with Barcodes.dat, Landmark_Groundtruth.dat and, of each robot n, Robot<n>_Odometry.dat (speed and yaw rate, each
row held until the next one), _Measurement.dat (barcode, range, bearing) and _Groundtruth.dat. All share one clock.

The subject of a measurement is a barcode: Barcodes.dat says of whom. Those that it does not know are misread, and left out.
Subjects 6 to 20 are the landmarks, on /landmarks; 1 to 5 are the other robots, which move, on /robots.
"""

from pathlib import Path

import numpy as np

from ..core.errors import BadFile
from ..core.geometry import seven_of_matrix
from ..core.measurement import SECOND, Array
from ..io.encode import encode_cloud
from ..io.formats.lines import Stamps
from ..io.formats.trajectory import Trajectory
from ..io.records import Record
from .gtsam_data import Content, planar
from .integrated import BASE, Rates, integrated, odometry_records
from .simulate import CLOUD

ROBOTS = range(1, 6)  # subjects that move


def read(folder: Path, robot: int) -> Content:
    """/odom, /landmarks and /robots of one robot, and its truth. BadFile names what is missing."""
    stamps, rows = _table(folder / f"Robot{robot}_Odometry.dat", 3)
    rates = Rates(stamps, rows[:, 0], rows[:, 1])
    stamps, rows = _table(folder / f"Robot{robot}_Groundtruth.dat", 4)
    poses = np.array([planar(*row).matrix() for row in rows.tolist()])
    truth = Trajectory(stamps, seven_of_matrix(poses))
    return Content([*odometry_records(rates, integrated(rates)), *_sightings(folder, robot)], truth)


def landmarks(folder: Path) -> dict[str, Array]:
    """Subject -> (2,) true position (m), in the truth's frame."""
    _, rows = _table(folder / "Landmark_Groundtruth.dat", 5, stamped=False)
    return {str(int(row[0])): row[1:3] for row in rows}


def _sightings(folder: Path, robot: int) -> list[Record]:
    """A cloud for each moment and topic."""
    _, pairs = _table(folder / "Barcodes.dat", 2, stamped=False)
    subjects = {int(barcode): int(subject) for subject, barcode in pairs.tolist()}
    stamps, rows = _table(folder / f"Robot{robot}_Measurement.dat", 4)
    seen = np.array([subjects.get(int(row[0]), 0) for row in rows])
    records = []
    for stamp in np.unique(stamps).tolist():
        for topic, wanted in (("/landmarks", seen > max(ROBOTS)), ("/robots", np.isin(seen, ROBOTS))):
            at = np.flatnonzero(wanted & (stamps == stamp))
            if len(at):
                columns = {
                    "id": seen[at].astype(np.uint32),
                    "range": rows[at, 1],
                    "azimuth": rows[at, 2],
                }
                records.append(Record(topic, CLOUD, stamp, encode_cloud(stamp, BASE, columns)))
    return records


def _table(path: Path, width: int, stamped: bool = True) -> tuple[Stamps, Array]:
    """Stamps in ns (their digits, not a float of seconds), and the columns after them; all columns where there are none."""
    try:
        lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise BadFile(f"{path}: {getattr(error, 'strerror', None) or 'is no text'}") from None
    words = [line for line in lines if line and not line[0].startswith("#")]
    wrong = f"{path}: is not a table of {width} numbers a line, as MRCLAM has it"
    if not words or any(len(line) != width for line in words):
        raise BadFile(wrong)
    try:
        stamps = [_nanoseconds(line[0]) for line in words] if stamped else []
        rows = np.array([line[stamped:] for line in words], dtype=np.float64)
    except ValueError:
        raise BadFile(wrong) from None
    return np.array(stamps, dtype=np.int64), rows


def _nanoseconds(text: str) -> int:
    whole, _, fraction = text.partition(".")
    return int(whole) * SECOND + int(fraction[:9].ljust(9, "0"))
