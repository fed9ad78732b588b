"""An inertial measurement unit: angular rates and accelerations, one preintegrated factor from keyframe to keyframe.

Each keyframe that it reaches has a velocity (in the map) and a bias besides its pose. What the samples add up to is kept by
`core/inertial.py`; here it becomes factors.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V

from ..config import ImuNoise, ImuSource
from ..context import Context
from ..graph import Delta, Factor, Keyframe, Motion, Offer
from ..inertial import GUESSED, UNMEASURED, Stretch
from ..measurement import SECOND, Array, Decoder, ImuSample, Message, format_stamp, frozen, stamp_of
from ..robust.kernels import noise_of

REST = 0.05  # m/s: how still a robot stands that stands still


def decode(message: Message, source: str) -> ImuSample:
    """sensor_msgs/msg/Imu; its orientation is not used: it is a filter's opinion of the same samples."""
    rate, acceleration = message.angular_velocity, message.linear_acceleration
    return ImuSample(
        stamp_of(message), source, message.header.frame_id,
        frozen((rate.x, rate.y, rate.z)), frozen((acceleration.x, acceleration.y, acceleration.z)),
        frozen(message.angular_velocity_covariance), frozen(message.linear_acceleration_covariance),
    )  # fmt: skip


DECODERS: Mapping[str, Decoder] = {"sensor_msgs/msg/Imu": decode}


def velocity_key(keyframe: Keyframe) -> int:
    return int(V(keyframe.index))


def bias_key(keyframe: Keyframe) -> int:
    return int(B(keyframe.index))


def factors(
    window: Sequence[Offer], a: Keyframe | None, b: Keyframe, context: Context, config: ImuSource
) -> Delta:
    """The preintegrated factor over (a, b]; where there is none, what else is known of velocity and bias at b.

    Where the IMU drives the keyframes (`motion` of the offer), the first guess of b's pose too.
    """
    stretch = context.stretch
    if stretch is None:
        return Delta()
    offer, end = window[-1], stretch.end
    values: dict[int, Any] = {velocity_key(b): end.velocity, bias_key(b): end.bias}
    if a is not None and offer.motion:
        values[b.pose] = end.pose
    known = a is not None and context.known(velocity_key(a)) and stretch.start is not None
    if a is None or not known or stretch.flaw:
        if a is not None and stretch.start is None:
            values[velocity_key(b)] = _velocity(a, b, context)
        return Delta(_anew(offer, a, b, stretch, values, known, config), values=values)
    keys = (a.pose, velocity_key(a), b.pose, velocity_key(b), bias_key(a), bias_key(b))
    factor = gtsam.CombinedImuFactor(*keys, stretch.measured)
    if not offer.motion:
        return Delta((_named(offer, 0, "imu", factor, keys, b),), values=values)
    return Delta((_named(offer, 0, "motion", factor, keys, b, stretch.motion),), values=values)


def _anew(
    offer: Offer, a: Keyframe | None, b: Keyframe, stretch: Stretch, values: Mapping[int, Any], known: bool,
    config: ImuSource,
) -> tuple[Factor, ...]:  # fmt: skip
    """Velocity and bias at b where no stretch that can be used leads there. known: a has them, too."""
    v, noise, found = velocity_key(b), config.stated, []
    speed = REST if stretch.rest else config.sigma_velocity
    if a is not None and known:  # the velocity is much the same, the bias walked on
        speed = GUESSED + UNMEASURED[0] * stretch.seconds
    if a is not None and offer.motion:
        motion = stretch.motion
        between = gtsam.BetweenFactorPose3(a.pose, b.pose, motion.pose, noise_of(motion.covariance))
        found.append(_named(offer, 0, "motion", between, (a.pose, b.pose), b))
    held = gtsam.PriorFactorVector(v, values[v], noise_of(np.eye(3) * speed**2))
    found.append(_named(offer, 1, "imu", held, (v,), b))
    return (*found, _bias(offer, a if known else None, b, stretch, noise))


def _bias(offer: Offer, a: Keyframe | None, b: Keyframe, stretch: Stretch, noise: ImuNoise) -> Factor:
    """The bias at b as it walked on from a; None: as it is when switched on."""
    if a is not None:
        walks = [noise.accelerometer_walk] * 3 + [noise.gyroscope_walk] * 3
        walked = noise_of(np.diag(np.square(walks) * stretch.seconds))
        keys = (bias_key(a), bias_key(b))
        tie = gtsam.BetweenFactorConstantBias(*keys, gtsam.imuBias.ConstantBias(), walked)
        return _named(offer, 2, "imu", tie, keys, b)
    sigmas = [noise.sigma_accelerometer_bias] * 3 + [noise.sigma_gyroscope_bias] * 3
    if stretch.rest:  # the gyroscope has told its own
        sigmas[3:] = [min(sigmas[3], 2 * noise.gyroscope_density / stretch.rest**0.5)] * 3
    prior = gtsam.PriorFactorConstantBias(bias_key(b), stretch.end.bias, noise_of(np.diag(np.square(sigmas))))
    return _named(offer, 2, "imu", prior, (bias_key(b),), b)


def _velocity(a: Keyframe, b: Keyframe, context: Context) -> Array:
    """By the motion that others tell."""
    moved = context.pose(b.pose).translation() - context.pose(a.pose).translation()
    return np.asarray(moved) * SECOND / (b.stamp - a.stamp)


def _named(
    offer: Offer,
    n: int,
    kind: str,
    factor: Any,
    keys: tuple[int, ...],
    b: Keyframe,
    motion: Motion | None = None,
) -> Factor:
    name = f"{offer.measurement.source}/{format_stamp(b.stamp)}/{n}"
    return Factor(name, kind, factor, keys, b.stamp, motion=motion)
