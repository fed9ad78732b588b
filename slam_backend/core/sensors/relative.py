"""The pose of one moment in another: loop closures, and motion where there is no odometry."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from ..errors import BadMessage
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
    from .cloud import columns

    table = columns(message)
    need = [*(f"stamp_{e}_{p}" for e in "ij" for p in ("sec", "nsec")), "x", "y", "z", "qx", "qy", "qz", "qw"]
    if missing := [name for name in need if name not in table]:
        raise BadMessage(f"point cloud of relative poses lacks the field '{missing[0]}'")
    frame, _ = parse_frame(message.header.frame_id)
    header = stamp_of(message)
    poses = np.stack([table[name] for name in need[4:]], axis=1)
    for n in range(len(poses)):
        stamp_i = int(table["stamp_i_sec"][n]) * SECOND + int(table["stamp_i_nsec"][n])
        stamp_j = int(table["stamp_j_sec"][n]) * SECOND + int(table["stamp_j_nsec"][n])
        yield RelativePose(
            max(header, stamp_i, stamp_j), source, stamp_i, stamp_j, frame, frame,
            frozen(poses[n]), frozen(_covariance(table, n)),
        )  # fmt: skip


def _covariance(table: dict[str, Array], n: int) -> Array:
    """36 numbers in ROS order from `cov` or `sigma_*`; zeros if the cloud states none."""
    if "cov" in table:
        return np.asarray(table["cov"][n], dtype=np.float64).reshape(36)
    axes = ("x", "y", "z", "roll", "pitch", "yaw")
    common = {axis: "sigma_translation" if axis in "xyz" else "sigma_rotation" for axis in axes}
    sigmas = np.zeros(6)
    for k, axis in enumerate(axes):
        for name in (f"sigma_{axis}", common[axis]):
            if name in table:
                sigmas[k] = table[name][n]
                break
    return np.diag(sigmas**2).reshape(36)


DECODERS: Mapping[str, Decoder] = {
    "nav_msgs/msg/Odometry": decode_odometry,
    "sensor_msgs/msg/PointCloud2": decode_points,
}
