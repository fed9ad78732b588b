"""One file per sensor; this table is the list of them."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from ..context import Context
from ..graph import Delta, Keyframe, Offer
from ..measurement import Decoder
from . import gnss, imu, landmark, odometry, pixels, pose, relative, static


class Sensor(NamedTuple):
    """decoders: ROS type name -> (message, source) -> measurements.

    factors: (window, a, b, context, config) -> Delta. window: what this source said since keyframe a (None at the
    first keyframe), and what came late; b: the new keyframe.
    """

    decoders: Mapping[str, Decoder]
    factors: Callable[[Sequence[Offer], Keyframe | None, Keyframe, Context, Any], Delta]


SENSORS: Mapping[str, Sensor] = {
    "odometry": Sensor(odometry.DECODERS, odometry.factors),
    "relative": Sensor(relative.DECODERS, relative.factors),
    "landmark": Sensor(landmark.DECODERS, landmark.factors),
    "gnss": Sensor(gnss.DECODERS, gnss.factors),
    "pose": Sensor(pose.DECODERS, pose.factors),
    "imu": Sensor(imu.DECODERS, imu.factors),
    "pixels": Sensor(pixels.DECODERS, pixels.factors),
    "static": Sensor(static.DECODERS, static.factors),
}
