"""Victoria Park as it was recorded: wheel, steering, detected tree trunks without ids, GPS (Guivant & Nebot, TRA 17(3), 2001).

A folder with aa3_dr.mat (time in ms, speed of the left rear wheel in m/s, steering in rad), aa3_gpsx.mat (time in ms,
longitude and latitude in m) and lidar_measurements.mat (range, bearing and diameter of each trunk, a row per scan).
What the files leave unsaid, and how it is read here:

Frames. The base is the middle of the rear axle; the laser stands 0.95 m before the front axle, 0.5 m to the left. Bearings
run from 0 to pi, pi/2 is ahead. The GPS positions are taken at the laser.

Time. Scans carry none: they are spread evenly over 21.94 to 1569.54 s, which is the span of the wheel's own rows.

Wheels. The encoder sits at the left rear wheel, H to the side: v = speed / (1 - tan(steer) H / L).
"""

from pathlib import Path

import numpy as np

from ..core.errors import BadFile
from ..core.geometry import seven_of_matrix
from ..core.measurement import SECOND, Array
from ..io.encode import encode_cloud
from ..io.formats.trajectory import Trajectory
from ..io.records import Record
from .gtsam_data import Content
from .integrated import Rates, integrated, odometry_records
from .matlab import read_arrays
from .simulate import CLOUD

LENGTH, WIDTH = 2.83, 0.76  # m: between the axles; from the encoder's wheel to the middle
LASER = (0.95 + LENGTH, 0.5, 0.0, 0.0, 0.0, 0.0)  # m, rad: in the base
SCANS = (21.94, 1569.54)  # s: the first and the last
LASER_FRAME = "laser"


def read(folder: Path) -> Content:
    """/odom and /trees, the truth at the laser. BadFile names what is missing."""
    wheels = _columns(folder / "aa3_dr.mat", "time", "speed", "steering")
    gps = _columns(folder / "aa3_gpsx.mat", "timeGps", "Lo_m", "La_m")
    steer = np.tan(wheels[:, 2])
    speed = wheels[:, 1] / (1 - steer * WIDTH / LENGTH)
    rates = Rates(_stamps(wheels[:, 0]), speed, speed * steer / LENGTH)
    sevens = seven_of_matrix(np.tile(np.eye(4), (len(gps), 1, 1)))
    sevens[:, :2] = gps[:, 1:]
    truth = Trajectory(_stamps(gps[:, 0]), sevens)
    return Content(
        [*odometry_records(rates, integrated(rates)), *_scans(folder / "lidar_measurements.mat")], truth
    )


def _scans(path: Path) -> list[Record]:
    """A cloud for each scan that saw a trunk; unused cells of the tables are zero."""
    ranges, bearings, diameters = _tables(path, "lidar_ranges", "lidar_bearings", "lidar_signatures")
    records = []
    for seconds, row in zip(np.linspace(*SCANS, len(ranges)).tolist(), range(len(ranges)), strict=True):
        seen = ranges[row] > 0
        if seen.any():
            stamp = round(seconds * SECOND)
            columns = {
                "range": ranges[row, seen],
                "azimuth": bearings[row, seen] - np.pi / 2,
                "diameter": diameters[row, seen],
            }
            records.append(Record("/trees", CLOUD, stamp, encode_cloud(stamp, LASER_FRAME, columns)))
    return records


def _stamps(milliseconds: Array) -> np.ndarray:
    return milliseconds.astype(np.int64) * (SECOND // 1000)


def _tables(path: Path, *names: str) -> list[Array]:
    found = read_arrays(path)
    for name in names:
        if name not in found:
            raise BadFile(f"{path}: holds no array '{name}'; this is not the file of Victoria Park")
    tables = [found[name] for name in names]
    if len({table.shape for table in tables}) > 1:
        raise BadFile(f"{path}: {', '.join(names)} have different sizes")
    return tables


def _columns(path: Path, *names: str) -> Array:
    """Vectors side by side, (N, k)."""
    return np.stack([table.ravel() for table in _tables(path, *names)], axis=1)
