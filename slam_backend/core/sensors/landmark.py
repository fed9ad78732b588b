"""Landmarks with known ids, seen from the robot: pose, position, bearing and range, or one of these alone."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isnan
from typing import Any, Literal, get_args

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..config import LandmarkSource
from ..context import Context, Unusable, defaulted, each
from ..errors import BadMessage
from ..graph import UNTIL_JOINED, Delta, Factor, Keyframe, Motion, Offer, Pose, Seen, Wait
from ..keyframes import Placed
from ..measurement import Array, Decoder, Measurement, Message, frozen, parse_frame, seven_of, stamp_of
from ..robust.kernels import noise_of
from ..space import Space
from ..variables import is_posed
from .drift import Drift
from .placing import is_due, place
from .ranging import PLACELESS, range_factor, sighting, told
from .tag import tag_from_keyframe, tilted

Form = Literal["pose", "position", "bearing_range", "bearing", "range"]
FORMS = frozenset(get_args(Form))

UNNAMED = "?"  # the frame of a sensor that its messages do not tell
NAMELESS = "?"  # what no message calls a landmark: which one it is must be found out
COUNTABLE = 2.0**53  # of double precision
NEAREST = 1e-6  # m; nearer, a landmark has no direction
PLACED = (gtsam.BearingRangeFactor2D, gtsam.BearingRangeFactor3D)  # one says where its landmark is
APART = "the landmark belongs to a part of the graph that is not connected yet"

EVERY = slice(None)
PLANE: Mapping[Form, slice] = {  # axes of a value that a plane has
    "position": slice(2), "bearing_range": slice(0, 3, 2), "bearing": slice(1), "range": slice(1),
}  # fmt: skip
QUATERNION = ("qx", "qy", "qz", "qw")
NOISY = ("x", "y", "z", "roll", "pitch", "yaw")  # axes of the noise of a pose
COMMON = dict.fromkeys("xyz", "sigma_position") | dict.fromkeys(NOISY[3:], "sigma_rotation")
COMMON |= {"azimuth": "sigma_bearing", "elevation": "sigma_bearing", "range": "sigma_range"}


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkObservation(Measurement):
    """One sighting of one landmark from `frame` (empty: the base).

    form      value                           covariance
    pose      x y z qx qy qz qw               6x6 in ROS order
    position  x y z (m)                       3x3
    bearing_range  azimuth elevation range    3x3
    bearing   azimuth elevation (rad)         2x2
    range     range (m)                       1x1
    landmark: its name; NAMELESS where the message has no ids; empty where it has one that names nothing.
    NaN on the diagonal of the covariance means: use the configured default. In 2-D z and elevation are not used, nor roll and pitch.
    """

    frame: str
    landmark: str
    form: Form
    value: Array
    covariance: Array


def decode_points(message: Message, source: str) -> Iterable[LandmarkObservation]:
    """sensor_msgs/msg/PointCloud2: one observation per point; the fields `x y [z]`, with `qx qy qz qw` where the landmark
    has an orientation, `range azimuth [elevation]`, `azimuth [elevation]` or `range`, and `id` where landmarks are known apart;
    noise by `cov` or `sigma_*`.
    """
    from .cloud import columns, scalars

    table = columns(message)
    frame, _ = parse_frame(message.header.frame_id)
    stamp, count = stamp_of(message), len(next(iter(table.values()), ()))
    zero = np.zeros(count)
    form: Form
    axes: tuple[str, ...]
    if "id" in table and table.keys() >= {"x", "y", *QUATERNION}:
        form, axes = "pose", ("x", "y", "z", *QUATERNION)
    elif "x" in table and "y" in table:
        form, axes = "position", ("x", "y", "z")
    elif "azimuth" in table and "range" in table:
        form, axes = "bearing_range", ("azimuth", "elevation", "range")
    elif "azimuth" in table:
        form, axes = "bearing", ("azimuth", "elevation")
    elif "range" in table:
        form, axes = "range", ("range",)
    else:
        raise BadMessage("point cloud of landmarks has neither 'x' and 'y' nor 'azimuth' nor 'range'")
    wanted = ("id", *axes) if "id" in table else axes
    values = scalars({"z": zero, "elevation": zero, **table}, wanted)[:, -len(axes) :]
    for n, name in enumerate(_names(table["id"]) if "id" in table else [NAMELESS] * count):
        yield LandmarkObservation(
            stamp, source, frame, name, form,
            frozen(values[n]), frozen(_covariance(table, n, NOISY if form == "pose" else axes)),
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
        for name in (f"sigma_{axis}", COMMON[axis], "sigma"):
            if name in table:
                sigmas[k] = table[name][n]
                break
    return np.diag(sigmas * np.abs(sigmas))  # one below zero stays so, and is refused


def decode_range(message: Message, source: str) -> Iterable[LandmarkObservation]:
    """sensor_msgs/msg/Range: one range to the beacon that `header.frame_id` names; nothing where no echo came back."""
    distance = float(message.range)
    if (
        isnan(distance) or message.min_range <= distance <= message.max_range
    ):  # NaN is for the firewall to tell
        beacon, _ = parse_frame(message.header.frame_id)
        variance = float(getattr(message, "variance", 0.0)) or np.nan  # before Jazzy it had no such field
        yield LandmarkObservation(
            stamp_of(message), source, UNNAMED, beacon, "range", frozen([distance]), frozen([[variance]])
        )


def decode_tag(message: Message, source: str) -> LandmarkObservation:
    """nav_msgs/msg/Odometry: one tag, named by `child_frame_id`, seen by the camera `header.frame_id`."""
    camera, _ = parse_frame(message.header.frame_id)
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    return LandmarkObservation(
        stamp_of(message), source, camera, message.child_frame_id, "pose",
        seven_of(message.pose.pose), frozen(covariance),
    )  # fmt: skip


DECODERS: Mapping[str, Decoder] = {
    "nav_msgs/msg/Odometry": decode_tag,
    "sensor_msgs/msg/PointCloud2": decode_points,
    "sensor_msgs/msg/Range": decode_range,
}


def factors(
    window: Sequence[Offer],
    a: Keyframe | None,  # noqa: ARG001
    b: Keyframe,  # noqa: ARG001
    context: Context,
    config: LandmarkSource,
) -> Delta:
    """A bearing-range factor per sighting (bearing alone: a bearing factor; a tag: a between factor); a new landmark starts where
    it is seen.

    There is no native factor for a position in the frame of a pose: a position is turned into bearing and
    range with its covariance to first order, which is exact enough while sigma is small beside the range.
    """
    points: dict[int, Any] = {}

    def sight(offer: Offer) -> Factor | Wait:
        return _sight(offer, context, config, points)

    delta = each(window, "landmark", sight)
    by_key: dict[int, list[Wait]] = defaultdict(list)
    for wait in delta.waits:
        if wait.until != UNTIL_JOINED:
            by_key[wait.until].append(wait)
    for key, new in by_key.items():
        old = [
            w for w in context.waiting(key) if w.offer.measurement.source == new[0].offer.measurement.source
        ]
        if is_due(len(old), len(old) + len(new), context.space.point_dimension):
            delta += _placed(key, [*old, *new], context, config, points, sight)
    made = {factor.id for factor in delta.add}
    waits = tuple(wait for wait in delta.waits if wait.offer.id not in made)
    return replace(delta, waits=waits, values=points)


def _placed(
    key: int,
    waits: Sequence[Wait],
    context: Context,
    config: LandmarkSource,
    points: dict[int, Array],
    sight: Callable[[Offer], Factor | Wait],
) -> Delta:
    """The factors of all that waited for a landmark, if that fixes where it is; else a decision that says why not."""
    newest = waits[-1].offer
    part = context.component(context.landing(newest.measurement.stamp).keyframe.pose)
    offers, sightings = [], []
    keyframes: dict[int, Keyframe] = {}
    for wait in waits:
        m = wait.offer.measurement
        assert isinstance(m, LandmarkObservation)
        with suppress(Unusable):  # any more: a keyframe may have been taken back since
            placed = context.landing(m.stamp)
            if context.component(placed.keyframe.pose) == part:
                seen = _in_space(m, context, config)
                sightings.append(sighting(m.form, seen, placed, _mount(m, context, config), context))
                offers.append(wait.offer)
                keyframes[placed.keyframe.pose] = placed.keyframe
    found = place(sightings, lambda keys: _drift([keyframes[key] for key in keys], context))
    assert isinstance(newest.measurement, LandmarkObservation)
    decision = told(newest, newest.measurement.landmark, found, len(sightings))
    if found.point is None:
        return Delta(decisions=(decision,))
    points[key] = found.point
    return each(offers, "landmark", sight) + Delta(decisions=(decision,))


def _drift(keyframes: Sequence[Keyframe], context: Context) -> Drift:
    """Of the driving source, from each keyframe to the next that saw the landmark."""
    steps = [context.motion(a.stamp, b.stamp).covariance for a, b in pairwise(keyframes)]
    return Drift([context.pose(each.pose) for each in keyframes], steps)


def _mount(m: LandmarkObservation, context: Context, config: LandmarkSource) -> Pose:
    return context.mount(config.frame if m.frame == UNNAMED else m.frame)


def level(
    m: LandmarkObservation, context: Context, config: LandmarkSource
) -> tuple[LandmarkObservation, Pose]:
    """The sighting, and where its sensor sits. In the plane, a position in the optical frame of a camera, or of another
    sensor that lies on its side, is turned upright in space before its height is dropped.
    """
    mount = _mount(m, context, config)
    whole = tilted(context, m.frame) if m.form == "position" else None
    if whole is None:
        return m, mount
    turn = whole.rotation().matrix()
    if not np.isfinite(m.value).all():
        raise Unusable("not_finite", "a tilted sensor needs x, y and z")
    noise = defaulted(m.covariance, (config.sigma_position**2,) * 3)
    upright = replace(m, value=whole.transformFrom(m.value), covariance=turn @ noise @ turn.T)
    return upright, context.space.identity


def _sight(offer: Offer, context: Context, config: LandmarkSource, points: dict[int, Any]) -> Factor | Wait:
    """One sighting; a landmark that it makes is added to `points`."""
    m = offer.measurement
    assert isinstance(m, LandmarkObservation)
    turned = m.form == "pose" and config.orientation
    key = context.tag(m.landmark) if turned else context.landmark(m.landmark)
    if is_posed(key):
        return _tag(offer, key, context, config, points)
    m, mount = level(positioned(m), context, config)
    placed = context.landing(m.stamp)
    pose_key, space = placed.keyframe.pose, context.space
    known = key in points or context.component(key) is not None
    value, covariance = _in_space(m, context, config)
    if key not in points and known and context.component(key) != context.component(pose_key):
        seen = None
        if m.form not in PLACELESS:
            _, _, point = _polar(m.form, (value, covariance), mount, placed.motion, space)
            seen = Seen(pose_key, key, point)
        return Wait(offer, UNTIL_JOINED, APART, seen)
    if m.form in PLACELESS and not known:
        return Wait(offer, key, f"one {m.form} alone cannot place a landmark")
    if m.form == "range":
        believed = points.get(key)
        if believed is None and placed.motion is not None:
            believed = context.point(key)
        return range_factor(offer, placed, mount, (value, covariance), key, believed, context, config)
    if m.form == "bearing":
        return _bearing(offer, placed, mount, (value, covariance), context, config, points)
    value, noise, point = _polar(m.form, (value, covariance), mount, placed.motion, space)
    if not known:
        points[key] = context.pose(pose_key).transformFrom(point)
    factor = space.observe(pose_key, key, value, noise_of(noise, config))
    return Factor(offer.id, "landmark", factor, (pose_key, key), offer.measurement.stamp)


def positioned(m: LandmarkObservation) -> LandmarkObservation:
    """A tag by its position alone; anything else as it is."""
    if m.form != "pose":
        return m
    return replace(m, form="position", value=m.value[:3], covariance=m.covariance[:3, :3])


def _tag(
    offer: Offer, key: int, context: Context, config: LandmarkSource, points: dict[int, Any]
) -> Factor | Wait:
    """One sighting of a landmark that has an orientation."""
    m = offer.measurement
    assert isinstance(m, LandmarkObservation)
    if m.form != "pose":
        raise Unusable("orientation", f"landmark {m.landmark} is a tag: send its orientation, too")
    placed, mount, space = context.landing(m.stamp), _mount(m, context, config), context.space
    pose_key = placed.keyframe.pose
    tag = tag_from_keyframe((m.value, m.covariance), m.frame, mount, placed.motion, context, config)
    if key not in points and context.apart(key, pose_key):
        return Wait(offer, UNTIL_JOINED, APART, Seen(pose_key, key, tag.pose))
    if key not in points and context.component(key) is None:
        points[key] = context.pose(pose_key).compose(tag.pose)
    factor = space.between(pose_key, key, tag.pose, noise_of(tag.covariance, config))
    return Factor(offer.id, "landmark", factor, (pose_key, key), m.stamp)


def as_point(
    m: LandmarkObservation, mount: Pose, motion: Motion | None, context: Context, config: LandmarkSource
) -> tuple[Array, Array]:
    """Where a landmark is from the keyframe, and the covariance of that. Not for a bearing alone."""
    value, covariance = _in_space(m, context, config)
    if m.form == "bearing_range":
        value, covariance = context.space.to_cartesian(value, covariance)
    return moved(value, covariance, mount, motion)


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


def _in_space(m: LandmarkObservation, context: Context, config: LandmarkSource) -> tuple[Array, Array]:
    """The value and covariance without the axes that the space lacks, zeros and NaN replaced by the defaults, ranges to scale."""
    keep, scale = _axes(m.form, context.space), context.correction.range_scale
    bearing = config.sigma_bearing**2
    span = config.sigma_range**2 + (config.sigma_range_per_meter * float(m.value[-1])) ** 2
    defaults = {
        "position": (config.sigma_position**2,) * 3,
        "bearing_range": (bearing, bearing, span),
        "bearing": (bearing, bearing),
        "range": (span,),
    }[m.form]
    value, covariance = m.value[keep], defaulted(m.covariance[keep, keep], defaults[keep])
    if scale != 1 and m.form in ("range", "bearing_range"):
        shrunk = np.ones(len(value))
        shrunk[-1] = 1 / scale
        value, covariance = value * shrunk, covariance * shrunk[:, None] * shrunk
    return value, covariance


def _axes(form: Form, space: Space) -> slice:
    """Of a value that is no pose, those that the space has."""
    return EVERY if space.name == "3d" else PLANE[form]


def used_axes(form: Form, size: int, space: Space) -> tuple[int, ...]:
    """Which of so many axes of noise the space has."""
    return tuple(space.used) if form == "pose" else tuple(range(size))[_axes(form, space)]
