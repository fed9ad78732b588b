"""One file per sensor; this table is the list of them."""

from collections.abc import Mapping
from typing import NamedTuple

from ..measurement import Decoder
from . import landmark, odometry, pose, relative


class Sensor(NamedTuple):
    """decoders: ROS type name -> (message, source) -> measurements."""

    decoders: Mapping[str, Decoder]


SENSORS: Mapping[str, Sensor] = {
    "odometry": Sensor(odometry.DECODERS),
    "relative": Sensor(relative.DECODERS),
    "landmark": Sensor(landmark.DECODERS),
    "pose": Sensor(pose.DECODERS),
}
