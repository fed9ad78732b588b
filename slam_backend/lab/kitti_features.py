"""Stereo features of KITTI odometry 00 inside gtsam's wheel (VO_*00s.txt), as a robot with a stereo camera would publish them.

A row of VO_stereo_factors is camera, feature, uL, uR, v and the point in the camera, which is not used; poses are `map_T_camera`
as a visual odometry left them. That odometry was made of the very same features: it is a first guess, and no measurement beside
them. KITTI's camera took 10 images a second. Pixels state no sigma.
"""

import gtsam
import numpy as np

from ..core.geometry import inverse_of, seven_of_matrix
from ..core.measurement import SECOND
from ..core.sensors.odometry import STILL, UNKNOWN
from ..io.encode import encode_camera_info, encode_cloud, encode_odometry, encode_transforms
from ..io.records import Record
from .gtsam_data import Content, rows
from .simulate import CLOUD, ODOMETRY, START

BASE, CAMERA = "base_link", "camera_left"  # the base is where the left camera is; x ahead, y left, z up
PERIOD = SECOND // 10  # ns between two images
INFO = "sensor_msgs/msg/CameraInfo"


def optical() -> gtsam.Pose3:
    """`base_T_camera` of a camera that looks ahead: z ahead, x right, y down."""
    return gtsam.Pose3(gtsam.Rot3.RzRyRx(-np.pi / 2, 0.0, -np.pi / 2), np.zeros(3))


def stereo() -> Content:
    """/odom, /features and /camera_right/camera_info, which has the baseline; on /tf_static where the camera looks."""
    mount = optical().matrix()
    cameras = np.array(rows("VO_camera_poses00s.txt"), dtype=np.float64)
    poses = mount @ cameras[:, 1:].reshape(-1, 4, 4) @ inverse_of(mount)
    seen = np.array(rows("VO_stereo_factors00s.txt"), dtype=np.float64)
    fx, fy, _, cx, cy, baseline = map(float, rows("VO_calibration00s.txt")[0])
    mounts = encode_transforms(START, BASE, {CAMERA: seven_of_matrix(mount)})
    records = [Record("/tf_static", "tf2_msgs/msg/TFMessage", START - SECOND // 1000, mounts)]
    for number, seven in zip(cameras[:, 0], seven_of_matrix(poses), strict=True):
        stamp = START + int(number) * PERIOD
        at = seen[seen[:, 0] == number]
        columns = {"id": at[:, 1].astype(np.uint32), "u": at[:, 2], "v": at[:, 4], "ur": at[:, 3]}
        odometry = encode_odometry(stamp, "odom", BASE, seven, UNKNOWN, STILL, UNKNOWN)
        records += [
            Record("/odom", ODOMETRY, stamp, odometry),
            Record("/camera_right/camera_info", INFO, stamp, encode_camera_info(stamp, "camera_right", (fx, fy, cx, cy), baseline)),
            Record("/features", CLOUD, stamp + SECOND // 1000, encode_cloud(stamp, CAMERA, columns)),
        ]  # fmt: skip
    return Content(records)
