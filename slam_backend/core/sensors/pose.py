"""Absolute pose of the base in the map frame: a prior, a localizer, /initialpose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..config import PoseSource
from ..context import Context, each, pose_covariance
from ..graph import Delta, Factor, Keyframe, Motion, Offer
from ..measurement import Array, Decoder, Measurement, Message, frozen, seven_of, stamp_of
from ..robust.kernels import noise_of


@dataclass(frozen=True, slots=True, eq=False)
class AbsolutePose(Measurement):
    """`parent_T_frame`; frame empty means the base, parent empty the map."""

    frame: str
    pose: Array  # (7,)
    covariance: Array  # (36,) in ROS order
    parent: str = ""


def decode(message: Message, source: str) -> AbsolutePose:
    """geometry_msgs/msg/PoseWithCovarianceStamped."""
    pose, covariance = seven_of(message.pose.pose), frozen(message.pose.covariance)
    return AbsolutePose(stamp_of(message), source, "", pose, covariance, message.header.frame_id)


DECODERS: Mapping[str, Decoder] = {"geometry_msgs/msg/PoseWithCovarianceStamped": decode}


def factors(
    window: Sequence[Offer],
    a: Keyframe | None,  # noqa: ARG001
    b: Keyframe,  # noqa: ARG001
    context: Context,
    config: PoseSource,
) -> Delta:
    """A prior on the nearest keyframe, seen through the motion since."""
    return each(window, "pose", lambda offer: _factor(offer, context, config))


def _factor(offer: Offer, context: Context, config: PoseSource) -> Factor:
    m, space = offer.measurement, context.space
    assert isinstance(m, AbsolutePose)
    placed, mount = context.landing(m.stamp), context.mount(m.frame)
    pose = space.pose(m.pose.tolist())
    covariance = pose_covariance(space, m.covariance, pose, config.sigma_rotation, config.sigma_translation)
    absolute = Motion(pose, covariance).then(Motion(mount.inverse(), np.zeros_like(covariance)))
    if placed.motion is not None:
        absolute = absolute.then(placed.motion.inverse())
    key = placed.keyframe.pose
    prior = space.prior(key, absolute.pose, noise_of(absolute.covariance, config))
    return Factor(offer.id, "pose", prior, (key,), m.stamp)
