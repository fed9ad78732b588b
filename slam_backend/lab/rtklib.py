"""RTKLIB: solutions of `rtkpost` or `rtkrcv` (.pos), and beside them what an IMU logger wrote (.csv).

A .pos file names its columns in the last line that begins with `%`: time, latitude, longitude (degrees), height (m), Q, ns, then
standard deviations sdn sde sdu and sdne sdeu sdun (m; of a covariance its signed root). Time is a date and a time of day, or a week
and its seconds; GPS time is taken as it stands, without leap seconds. Q: 1 fixed, 2 float, 3 SBAS, 4 DGPS, 5 single, 6 PPP.

imu*.csv: accelerations x y z (g), rates x y z (degrees/s), time (ms since some moment of its own). Its clock is laid onto the
receiver's by the rate of turn: that of the course where the receiver moves, beside that of each axis.
"""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from ..core.errors import BadFile
from ..core.measurement import SECOND, Array
from ..core.sensors.gnss import enu
from ..core.trajectory import Stamps
from ..io.encode import encode_fix, encode_imu
from ..io.records import Record
from .gtsam_data import Content

FIX, IMU = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
STATUS = {1: 2, 2: 2, 3: 1, 4: 2}  # Q -> of NavSatStatus; others: 0
GRAVITY = 9.80665  # m/s^2 in a g
STEP = 0.05  # s, of the comparison of clocks
MOVING = 2.0  # m/s, from where on a course is known


def read(folder: Path) -> Content:
    """/fix from the folder's only .pos file; /imu from imu*.csv, if there is one. BadFile says what is wrong."""
    found = sorted(folder.glob("*.pos"))
    if len(found) != 1:
        raise BadFile(f"{folder}: holds {len(found)} files .pos, and one is needed")
    stamps, places, covariances, quality = solution(found[0])
    records = [
        Record("/fix", FIX, stamp, encode_fix(stamp, "gps", place, covariance, STATUS.get(q, 0)))
        for stamp, place, covariance, q in zip(
            stamps.tolist(), places, covariances, quality.tolist(), strict=True
        )
    ]
    for path in sorted(folder.glob("imu*.csv")):
        records += _imu(path, stamps, places)
    return Content(records)


def solution(path: Path) -> tuple[Stamps, Array, Array, Stamps]:
    """(N,) ns, (N, 3) latitude, longitude, height, (N, 3, 3) east, north, up, (N,) Q. BadFile names the line."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise BadFile(f"{path}: {getattr(error, 'strerror', None) or 'is no text'}") from None
    heads = [line for line in lines if line.startswith("%")]
    if not heads or "latitude(deg)" not in heads[-1]:
        raise BadFile(
            f"{path}: no line names its columns, or they are not latitude(deg) longitude(deg) height(m)"
        )
    stamps, rows = [], []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("%"):
            continue
        words = line.split()
        try:
            stamps.append(_nanoseconds(words[0], words[1]))
            rows.append([float(word) for word in words[2:13]])
        except (ValueError, IndexError):
            raise BadFile(f"{path}:{number}: is no line of a solution: {line[:60]}") from None
        if len(rows[-1]) != 11:
            raise BadFile(f"{path}:{number}: ends before its standard deviations")
    if not rows:
        raise BadFile(f"{path}: holds no solution")
    table = np.array(rows)
    north, east, up, ne, eu, un = table[:, 5:].T
    covariances = np.zeros((len(table), 3, 3))
    for i, j, value in ((0, 0, east), (1, 1, north), (2, 2, up), (0, 1, ne), (0, 2, eu), (1, 2, un)):
        covariances[:, i, j] = covariances[:, j, i] = np.abs(value) * value
    return np.array(stamps, dtype=np.int64), table[:, :3], covariances, table[:, 3].astype(np.int64)


def _nanoseconds(first: str, second: str) -> int:
    """A date and a time of day, or a GPS week and its seconds; without rounding."""
    if "/" in first:
        clock, _, fraction = second.partition(".")
        moment = datetime.strptime(f"{first} {clock}", "%Y/%m/%d %H:%M:%S").replace(tzinfo=UTC)
    else:
        whole, _, fraction = second.partition(".")
        moment = GPS_EPOCH + timedelta(weeks=int(first), seconds=int(whole))
    return int(moment.timestamp()) * SECOND + int((fraction or "0")[:9].ljust(9, "0"))


def _imu(path: Path, stamps: Stamps, places: Array) -> list[Record]:
    try:
        table = np.loadtxt(path, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise BadFile(f"{path}: {error}") from None
    if table.shape[1] != 7 or len(table) < 2:
        raise BadFile(f"{path}: has {table.shape[1]} columns where acceleration, rate and time make 7")
    times, first = np.unique(table[:, 6], return_index=True)  # a sample that comes again says nothing new
    accelerations, rates = table[first, :3] * GRAVITY, np.radians(table[first, 3:6])
    shift = offset(times / 1e3, rates, (stamps - stamps[0]) / SECOND, enu(places, places[0])[:, :2])
    unstated = np.zeros(9)
    records = []
    for time, rate, acceleration in zip(times, rates, accelerations, strict=True):
        stamp = int(stamps[0]) + round((time / 1e3 + shift) * SECOND)
        records.append(
            Record("/imu", IMU, stamp, encode_imu(stamp, "imu", rate, acceleration, unstated, unstated))
        )
    return records


def offset(times: Array, rates: Array, seconds: Array, track: Array) -> float:
    """Seconds to add to the IMU's (M,) times so that its (M, 3) rates fit the course along (N, 2) m east and north at (N,) s.

    The best correlation over all shifts for which the shorter of the two lies within the other, for the axis that fits best.
    """
    grid = np.arange(seconds[0], seconds[-1], STEP)
    middle = (seconds[1:] + seconds[:-1]) / 2
    velocity = np.diff(track, axis=0) / np.diff(seconds)[:, None]
    course = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    turning = np.gradient(course, middle) * (np.linalg.norm(velocity, axis=1) > MOVING)
    theirs = np.interp(grid, middle, turning)
    best = (0.0, 0.0)
    own_grid = np.arange(times[0], times[-1], STEP)
    for axis in range(3):
        own = np.interp(own_grid, times, rates[:, axis] - np.median(rates[:, axis]))
        found = np.correlate(np.pad(own, len(grid)), theirs, mode="valid") / (np.linalg.norm(own) or 1.0)
        at = int(np.argmax(np.abs(found)))
        if abs(found[at]) > best[0]:
            best = abs(float(found[at])), float(grid[0] - (own_grid[0] + (at - len(grid)) * STEP))
    return best[1]
