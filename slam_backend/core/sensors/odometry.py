"""Wheel, visual or lidar odometry: the pose of the base in a drifting frame."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..config import OdometrySource
from ..context import Context
from ..graph import Delta, Factor, Keyframe, Offer
from ..measurement import Array, Decoder, Measurement, Message, format_stamp, frozen, seven_of, stamp_of
from ..robust.kernels import noise_of
from ..space import Space

HERE: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
UNKNOWN = frozen(np.zeros(36))  # a covariance of zeros means: use the configured default


@dataclass(frozen=True, slots=True, eq=False)
class OdometryPose(Measurement):
    """`frame_T_child` with what the message says of its noise, all in ROS order.

    epoch: how often the odometry has restarted; nothing measured the motion from one to the next. origin: the frame as the
    messages of this epoch have it, in that of the first; the pose is in that of the first.
    """

    frame: str
    child: str
    pose: Array  # (7,) x y z qx qy qz qw
    covariance: Array  # (36,) of the pose
    twist: Array  # (6,) m/s and rad/s in the child frame
    twist_covariance: Array  # (36,)
    epoch: int = 0
    origin: tuple[float, ...] = HERE


STILL = frozen(np.zeros(6))
PARENT = "odom"  # REP 105's name of the drifting frame, in whatever namespace


def decode_odometry(message: Message, source: str) -> OdometryPose:
    """nav_msgs/msg/Odometry."""
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    return OdometryPose(
        stamp_of(message),
        source,
        message.header.frame_id,
        message.child_frame_id,
        seven_of(message.pose.pose),
        frozen(message.pose.covariance),
        frozen((linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)),
        frozen(message.twist.covariance),
    )


def decode_pose_with_covariance(message: Message, source: str) -> OdometryPose:
    """geometry_msgs/msg/PoseWithCovarianceStamped."""
    return OdometryPose(
        stamp_of(message), source, message.header.frame_id, "", seven_of(message.pose.pose),
        frozen(message.pose.covariance), STILL, UNKNOWN,
    )  # fmt: skip


def decode_pose(message: Message, source: str) -> OdometryPose:
    """geometry_msgs/msg/PoseStamped."""
    return OdometryPose(
        stamp_of(message),
        source,
        message.header.frame_id,
        "",
        seven_of(message.pose),
        UNKNOWN,
        STILL,
        UNKNOWN,
    )


def decode_transforms(message: Message, source: str) -> Iterable[OdometryPose]:
    """tf2_msgs/msg/TFMessage: the pairs odom -> base among its transforms, for robots that publish no odometry else."""
    for each in message.transforms:
        if each.header.frame_id.rpartition("/")[2] == PARENT:
            p, q = each.transform.translation, each.transform.rotation
            seven = frozen((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
            frames = each.header.frame_id, each.child_frame_id
            yield OdometryPose(stamp_of(each), source, *frames, seven, UNKNOWN, STILL, UNKNOWN)


TRANSFORMS = "tf2_msgs/msg/TFMessage"
DECODERS: Mapping[str, Decoder] = {
    "nav_msgs/msg/Odometry": decode_odometry,
    "geometry_msgs/msg/PoseWithCovarianceStamped": decode_pose_with_covariance,
    "geometry_msgs/msg/PoseStamped": decode_pose,
    TRANSFORMS: decode_transforms,
}


def stated(space: Space, config: OdometrySource, item: OdometryPose, seconds: float) -> Array | None:
    """What `noise` needs of a message, at the tangent of its child: of its pose, of the step over these seconds, or nothing."""
    if config.noise == "pose":
        return space.covariance(item.covariance, space.pose(item.pose.tolist()))
    if config.noise == "twist":
        return space.twist_covariance(item.twist_covariance) * seconds**2
    return None


def factors(
    window: Sequence[Offer],
    a: Keyframe | None,
    b: Keyframe,
    context: Context,
    config: OdometrySource,  # noqa: ARG001  # its noise is in the track's motion
) -> Delta:
    """One between factor over (a, b], however many messages the window holds, and the first guess of b."""
    if a is None or not window:
        return Delta()
    motion = context.motion(a.stamp, b.stamp)
    guess = context.pose(a.pose).compose(motion.pose)
    factor = context.space.between(a.pose, b.pose, motion.pose, noise_of(motion.covariance))
    name = f"{window[-1].measurement.source}/{format_stamp(b.stamp)}/0"
    return Delta((Factor(name, "motion", factor, (a.pose, b.pose), b.stamp),), values={b.pose: guess})
