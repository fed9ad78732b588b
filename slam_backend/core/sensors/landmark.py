"""Landmarks with known ids, seen from the robot: position, bearing and range, bearing alone."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..config import LandmarkSource
from ..context import Context, Unusable, defaulted, each
from ..errors import BadMessage
from ..graph import UNTIL_JOINED, Delta, Factor, Keyframe, Motion, Offer, Pose, Seen, Wait
from ..keyframes import Placed
from ..measurement import Array, Decoder, Measurement, Message, frozen, parse_frame, stamp_of
from ..robust.kernels import noise_of
from ..space import Space

Form = Literal["position", "bearing_range", "bearing"]
FORMS = frozenset(get_args(Form))

COUNTABLE = 2.0**53  # of double precision
NEAREST = 1e-6  # m; nearer, a landmark has no direction


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkObservation(Measurement):
    """One sighting of one landmark from `frame` (empty: the base).

    form      value                           covariance
    position  x y z (m)                       3x3
    bearing_range  azimuth elevation range    3x3
    bearing   azimuth elevation (rad)         2x2
    landmark: its name; empty where the message has none that can be.
    NaN on the diagonal of the covariance means: use the configured default. In 2-D z and elevation are not used.
    """

    frame: str
    landmark: str
    form: Form
    value: Array
    covariance: Array


def decode_points(message: Message, source: str) -> Iterable[LandmarkObservation]:
    """sensor_msgs/msg/PointCloud2: one observation per point; the fields `id` and `x y [z]`,
    `range azimuth [elevation]` or `azimuth [elevation]`; noise by `cov` or `sigma_*`.
    """
    from .cloud import columns, scalars

    table = columns(message)
    if "id" not in table:
        raise BadMessage("point cloud of landmarks lacks the field 'id'")
    frame, _ = parse_frame(message.header.frame_id)
    stamp, count = stamp_of(message), len(table["id"])
    zero = np.zeros(count)
    form: Form
    axes: tuple[str, ...]
    if "x" in table and "y" in table:
        form, axes = "position", ("x", "y", "z")
    elif "azimuth" in table and "range" in table:
        form, axes = "bearing_range", ("azimuth", "elevation", "range")
    elif "azimuth" in table:
        form, axes = "bearing", ("azimuth", "elevation")
    else:
        raise BadMessage("point cloud of landmarks has neither 'x' and 'y' nor 'azimuth'")
    values = scalars({"z": zero, "elevation": zero, **table}, ("id", *axes))[:, 1:]
    for n, name in enumerate(_names(table["id"])):
        yield LandmarkObservation(
            stamp, source, frame, name, form,
            frozen(values[n]), frozen(_covariance(table, n, axes)),
        )  # fmt: skip


def _names(ids: NDArray[Any]) -> list[str]:
    """Empty for what cannot be told apart from other names: NaN, infinity, floats too large to count by ones."""
    if ids.dtype.kind != "f":
        return [str(value) for value in ids.tolist()]
    return [
        "" if not abs(value) < COUNTABLE else str(int(value)) if value.is_integer() else repr(value)
        for value in ids.tolist()
    ]


def _covariance(table: dict[str, Array], n: int, axes: tuple[str, ...]) -> Array:
    size = len(axes)
    if "cov" in table:
        given = np.asarray(table["cov"][n], dtype=np.float64).ravel()
        if given.size != size * size:
            raise BadMessage(f"'cov' has {given.size} numbers where {size * size} are needed")
        return given.reshape(size, size)
    sigmas = np.full(size, np.nan)
    for k, axis in enumerate(axes):
        common = "sigma_position" if axis in "xyz" else "sigma_range" if axis == "range" else "sigma_bearing"
        for name in (f"sigma_{axis}", common, "sigma"):
            if name in table:
                sigmas[k] = table[name][n]
                break
    return np.diag(sigmas**2)


DECODERS: Mapping[str, Decoder] = {"sensor_msgs/msg/PointCloud2": decode_points}


def factors(
    window: Sequence[Offer],
    a: Keyframe | None,  # noqa: ARG001
    b: Keyframe,  # noqa: ARG001
    context: Context,
    config: LandmarkSource,
) -> Delta:
    """A bearing-range factor per sighting (bearing alone: a bearing factor); a new landmark starts where it is seen.

    There is no native factor for a position in the frame of a pose: a position is turned into bearing and
    range with its covariance to first order, which is exact enough while sigma is small beside the range.
    """
    points: dict[int, Array] = {}
    delta = each(window, "landmark", lambda offer: _sight(offer, context, config, points))
    return replace(delta, values=points)


def _sight(offer: Offer, context: Context, config: LandmarkSource, points: dict[int, Array]) -> Factor | Wait:
    """One sighting; a landmark that it makes is added to `points`."""
    m = offer.measurement
    assert isinstance(m, LandmarkObservation)
    placed, mount = context.landing(m.stamp), context.mount(m.frame)
    key, pose_key, space = context.landmark(m.landmark), placed.keyframe.pose, context.space
    known = key in points or context.component(key) is not None
    value, covariance = _in_space(m, space, config)
    if key not in points and known and context.component(key) != context.component(pose_key):
        why, seen = "the landmark belongs to a part of the graph that is not connected yet", None
        if m.form != "bearing":
            _, _, point = _polar(m.form, (value, covariance), mount, placed.motion, space)
            seen = Seen(pose_key, key, point)
        return Wait(offer, UNTIL_JOINED, why, seen)
    if m.form == "bearing":
        if not known:
            return Wait(offer, key, "a bearing alone cannot place a landmark")
        return _bearing(offer, placed, mount, (value, covariance), context, config, points)
    value, noise, point = _polar(m.form, (value, covariance), mount, placed.motion, space)
    if not known:
        points[key] = context.pose(pose_key).transformFrom(point)
    factor = space.observe(pose_key, key, value, noise_of(noise, config))
    return Factor(offer.id, "landmark", factor, (pose_key, key), offer.measurement.stamp)


def _polar(
    form: Form, seen: tuple[Array, Array], mount: Pose, motion: Motion | None, space: Space
) -> tuple[Array, Array, Array]:
    """Value and covariance for the native factor, and the point, all from the keyframe."""
    value, covariance = seen
    if form == "bearing_range":
        if mount is space.identity and motion is None:
            point = space.direction(value[0], value[1]) * value[-1]
            return value, space.bearing_noise(value, covariance), point
        value, covariance = space.to_cartesian(value, covariance)
    point, covariance = moved(value, covariance, mount, motion)
    if np.linalg.norm(point) < NEAREST:
        raise Unusable("range", "the landmark is where the robot is")
    return (*space.to_polar(point, covariance), point)


def _bearing(
    offer: Offer,
    placed: Placed,
    mount: Pose,
    seen: tuple[Array, Array],
    context: Context,
    config: LandmarkSource,
    points: dict[int, Array],
) -> Factor:
    """A bearing of a landmark that has a position. From beside the keyframe it is carried over, noise and all, at the
    landmark's present distance: the offset is short beside it, and there is no native bearing factor with an offset.
    """
    (value, covariance), space = seen, context.space
    m = offer.measurement
    assert isinstance(m, LandmarkObservation)
    key, pose_key = context.landmark(m.landmark), placed.keyframe.pose
    if mount is space.identity and placed.motion is None:
        noise = space.bearing_noise(value, covariance)
    else:
        sensor = placed.motion.pose.compose(mount) if placed.motion else mount
        point = points[key] if key in points else context.point(key)
        distance = float(np.linalg.norm(context.pose(pose_key).compose(sensor).transformTo(point)))
        exact = np.pad(covariance, (0, 1))  # the distance is a point to linearize at, not a measurement
        polar = np.append(value, max(distance, 1e-3)), exact
        value, noise, _ = _polar("bearing_range", polar, mount, placed.motion, space)
        value, noise = value[:-1], noise[:-1, :-1]
    factor = space.observe_bearing(pose_key, key, value, noise_of(noise, config))
    return Factor(offer.id, "landmark", factor, (pose_key, key), offer.measurement.stamp)


def moved(point: Array, covariance: Array, mount: Pose, motion: Motion | None) -> tuple[Array, Array]:
    """A point in the sensor's frame, seen from the keyframe, with the motion's noise added (first order)."""
    rotation = mount.rotation().matrix()
    point, covariance = mount.transformFrom(point), rotation @ covariance @ rotation.T
    if motion is None:
        return point, covariance
    size = len(point)
    of_pose = np.zeros((size, len(motion.covariance)), order="F")
    of_point = np.zeros((size, size), order="F")
    there = motion.pose.transformFrom(point, of_pose, of_point)
    return there, of_pose @ motion.covariance @ of_pose.T + of_point @ covariance @ of_point.T


def _in_space(m: LandmarkObservation, space: Space, config: LandmarkSource) -> tuple[Array, Array]:
    """The value and covariance without the axes that the space lacks, zeros and NaN replaced by the defaults."""
    bearing, span = config.sigma_bearing**2, config.sigma_range**2
    defaults = {
        "position": (config.sigma_position**2,) * 3,
        "bearing_range": (bearing, bearing, span),
        "bearing": (bearing, bearing),
    }[m.form]
    keep = [k for k in range(len(m.value)) if space.name == "3d" or k != vertical(m.form)]
    covariance = defaulted(m.covariance[np.ix_(keep, keep)], np.diag([defaults[k] for k in keep]))
    return m.value[keep], covariance


def vertical(form: Form) -> int:
    """The axis of a value that a plane does not have."""
    return 2 if form == "position" else 1
