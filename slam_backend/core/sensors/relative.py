"""The pose of one moment in another: loop closures, and motion where there is no odometry."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from ..config import RelativeSource
from ..context import Context, Unusable, each, pose_covariance
from ..errors import BadMessage
from ..graph import Delta, Factor, Keyframe, Motion, Offer, Pose
from ..measurement import (
    SECOND,
    Array,
    Decoder,
    Measurement,
    Message,
    frozen,
    parse_frame,
    seven_of,
    stamp_of,
)
from ..robust.kernels import noise_of, with_kernel


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose(Measurement):
    """`i_T_j`, i = `frame_i` at `stamp_i`. `stamp` is when it can be applied: the latest of both and of its header.

    Noise: `information` where a graph file states one (6x6 in GTSAM order, or 3x3 for x y yaw, at the
    tangent of j); else `covariance` in ROS order, zeros meaning the configured default.
    """

    stamp_i: int
    stamp_j: int
    frame_i: str
    frame_j: str
    pose: Array  # (7,)
    covariance: Array  # (36,)
    information: Array | None = None

    @property
    def ends(self) -> tuple[int, int]:
        return self.stamp_i, self.stamp_j


def decode_odometry(message: Message, source: str) -> RelativePose:
    """nav_msgs/msg/Odometry with `frame_id = base@<ti>`, `child_frame_id = base@<tj>` and the pose `i_T_j`."""
    try:
        frame_i, stamp_i = parse_frame(message.header.frame_id)
        frame_j, stamp_j = parse_frame(message.child_frame_id)
    except ValueError as error:
        raise BadMessage(str(error)) from None
    if stamp_i is None or stamp_j is None:
        raise BadMessage(
            f"frames '{message.header.frame_id}' and '{message.child_frame_id}' do not say when: write base@<sec>.<nsec>"
        )
    stamp = max(stamp_of(message), stamp_i, stamp_j)
    return RelativePose(
        stamp, source, stamp_i, stamp_j, frame_i, frame_j,
        seven_of(message.pose.pose), frozen(message.pose.covariance),
    )  # fmt: skip


def decode_points(message: Message, source: str) -> Iterable[RelativePose]:
    """sensor_msgs/msg/PointCloud2: a batch, one relative pose per point, by field names."""
    from .cloud import columns, scalars

    table = columns(message)
    need = [*(f"stamp_{e}_{p}" for e in "ij" for p in ("sec", "nsec")), "x", "y", "z", "qx", "qy", "qz", "qw"]
    if missing := [name for name in need if name not in table]:
        raise BadMessage(f"point cloud of relative poses lacks the field '{missing[0]}'")
    frame, _ = parse_frame(message.header.frame_id)
    header = stamp_of(message)
    poses, times = scalars(table, need[4:]), scalars(table, need[:4])
    if not np.isfinite(times).all():
        raise BadMessage("point cloud of relative poses holds a stamp that is no number")
    for n in range(len(poses)):
        i_sec, i_nsec, j_sec, j_nsec = (int(part) for part in times[n])
        stamp_i, stamp_j = i_sec * SECOND + i_nsec, j_sec * SECOND + j_nsec
        yield RelativePose(
            max(header, stamp_i, stamp_j), source, stamp_i, stamp_j, frame, frame,
            frozen(poses[n]), frozen(_covariance(table, n)),
        )  # fmt: skip


def _covariance(table: dict[str, Array], n: int) -> Array:
    """36 numbers in ROS order from `cov` or `sigma_*`; zeros if the cloud states none."""
    if "cov" in table:
        given = np.asarray(table["cov"][n], dtype=np.float64).ravel()
        if given.size != 36:
            raise BadMessage(f"'cov' has {given.size} numbers where 36 are needed")
        return given
    axes = ("x", "y", "z", "roll", "pitch", "yaw")
    common = {axis: "sigma_translation" if axis in "xyz" else "sigma_rotation" for axis in axes}
    sigmas = np.zeros(6)
    for k, axis in enumerate(axes):
        for name in (f"sigma_{axis}", common[axis]):
            if name in table:
                sigmas[k] = table[name][n]
                break
    return np.diag(sigmas * np.abs(sigmas)).reshape(36)  # one below zero stays so, and is refused


DECODERS: Mapping[str, Decoder] = {
    "nav_msgs/msg/Odometry": decode_odometry,
    "sensor_msgs/msg/PointCloud2": decode_points,
}


def factors(
    window: Sequence[Offer],
    a: Keyframe | None,  # noqa: ARG001  # any two moments, not the newest step
    b: Keyframe,  # noqa: ARG001
    context: Context,
    config: RelativeSource,
) -> Delta:
    """A between factor per measurement; both ends land at the nearest keyframes, at their own stamps."""
    return each(window, "relative", lambda offer: _factor(offer, context, config))


def _factor(offer: Offer, context: Context, config: RelativeSource) -> Factor:
    m = offer.measurement
    assert isinstance(m, RelativePose)
    a, b = context.landing(m.stamp_i), context.landing(m.stamp_j)
    if a.keyframe is b.keyframe:
        raise Unusable("one_keyframe", "both ends land at the same keyframe")
    mount_i, mount_j = context.mount(m.frame_i), context.mount(m.frame_j)
    space = context.space
    pose = space.pose(m.pose.tolist())
    if (
        a.motion is None
        and b.motion is None
        and mount_i is mount_j is space.identity
        and m.information is not None
    ):
        noise = with_kernel(gtsam.noiseModel.Gaussian.Information(space.information(m.information)), config)
    else:
        moved = _shifted(_measured(m, pose, context, config), mount_i, mount_j)
        moved = a.motion.then(moved) if a.motion else moved
        moved = moved.then(b.motion.inverse()) if b.motion else moved
        pose, noise = moved.pose, noise_of(moved.covariance, config)
    keys = (a.keyframe.pose, b.keyframe.pose)
    kind = "motion" if offer.motion else "loop"
    return Factor(offer.id, kind, space.between(*keys, pose, noise), keys, m.stamp, m.ends)


def _measured(m: RelativePose, pose: Pose, context: Context, config: RelativeSource) -> Motion:
    space = context.space
    if m.information is not None:
        return Motion(pose, np.asarray(np.linalg.inv(space.information(m.information))))
    return Motion(
        pose, pose_covariance(space, m.covariance, pose, config.sigma_rotation, config.sigma_translation)
    )


def _shifted(measured: Motion, mount_i: Pose, mount_j: Pose) -> Motion:
    """From between two sensors to between the bases that carry them."""
    exact = np.zeros_like(measured.covariance)
    return Motion(mount_i, exact).then(measured).then(Motion(mount_j.inverse(), exact))


def step(m: RelativePose, context: Context) -> Pose:
    """`base_i_T_base_j` as measured; Unusable when a frame is unknown."""
    mount_i, mount_j = context.mount(m.frame_i), context.mount(m.frame_j)
    return mount_i.compose(context.space.pose(m.pose.tolist())).compose(mount_j.inverse())
