"""Absolute pose of the base in the map frame: a prior, a localizer, /initialpose."""

from collections.abc import Mapping
from dataclasses import dataclass

from ..measurement import Array, Decoder, Measurement, Message, frozen, seven_of, stamp_of


@dataclass(frozen=True, slots=True, eq=False)
class AbsolutePose(Measurement):
    """`map_T_frame`; frame empty means the base."""

    frame: str
    pose: Array  # (7,)
    covariance: Array  # (36,) in ROS order


def decode(message: Message, source: str) -> AbsolutePose:
    """geometry_msgs/msg/PoseWithCovarianceStamped."""
    return AbsolutePose(
        stamp_of(message), source, "", seven_of(message.pose.pose), frozen(message.pose.covariance)
    )


DECODERS: Mapping[str, Decoder] = {"geometry_msgs/msg/PoseWithCovarianceStamped": decode}
