"""A car in a town, from gtsam's wheel: KittiEquivBiasedImu.txt and KittiGps_converted.txt (a KITTI raw drive, Geiger et al., IJRR 2013).

What the files leave unsaid, and how it is read here. A row of the IMU holds from the stamp of the row before to its own; the first has
nothing before it, and a gap of 1.9 s behind it. The fixes are metres east, north and up of a place that is not told: they are put on the
earth around Karlsruhe, where KITTI drove. Their noise is not stated: 0.07 m agrees with the IMU. The metadata's densities of the IMU
(0.01 m/s^2 and 0.000175 rad/s per root hertz) are ten times too small for its equivalent samples: the covariances say ten times as much.
"""

import numpy as np
import pymap3d

from ..core.measurement import SECOND, frozen
from ..io.encode import encode_fix, encode_imu
from ..io.records import Record
from .gtsam_data import Content, rows

ORIGIN = (49.0, 8.43, 115.0)  # degrees, degrees, m
FRAME = "base_link"
PERIOD = 0.01  # s
DENSITIES = 0.1, 0.00175  # m/s^2/sqrt(Hz), rad/s/sqrt(Hz)
SIGMA_FIX = 0.07  # m


def kitti_imu_gnss() -> Content:
    samples = np.array(rows("KittiEquivBiasedImu.txt")[1:], dtype=np.float64)
    accelerometer, gyroscope = (frozen(np.eye(3).ravel() * d**2 / PERIOD) for d in DENSITIES)
    records = []
    for time, _, *numbers in samples.tolist():
        stamp = round(time * SECOND)
        data = encode_imu(stamp, FRAME, numbers[3:], numbers[:3], gyroscope, accelerometer)
        records.append(Record("/imu", "sensor_msgs/msg/Imu", stamp, data))
    fixes = np.array([line[0].split(",") for line in rows("KittiGps_converted.txt")[1:]], dtype=np.float64)
    covariance = np.eye(3).ravel() * SIGMA_FIX**2
    for time, *place in fixes.tolist():
        stamp = round(time * SECOND)
        data = encode_fix(stamp, FRAME, pymap3d.enu2geodetic(*place, *ORIGIN), covariance)
        records.append(Record("/fix", "sensor_msgs/msg/NavSatFix", stamp + SECOND // 1000, data))
    return Content(records)
