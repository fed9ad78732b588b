"""What the back-end is told: one frozen record per thing that a sensor said.

Conventions, everywhere in this package:
    stamps       int, nanoseconds of the sensor's own clock (`header.stamp`)
    lengths      metres; angles radians; latitude and longitude degrees
    seven        (7,) float64: x y z qx qy qz qw, as ROS writes a pose
    `a_T_b`      pose of b in a; `a_p_b` position of b in a
    covariance   at the edge as ROS has it: 6x6 row by row, x y z then rotations about the fixed axes of the
                 parent; inside, at the tangent of the child in GTSAM's order (rotation first in 3-D; x y yaw in 2-D)
Arrays in records are read-only. Records neither compare nor hash (`eq=False`): their arrays could not.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Message = Any  # rclpy's class or rosbags' dataclass: the same fields, no common base

SECOND = 1_000_000_000  # ns


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """The head of every record: when it is to be applied, and which configured source said it."""

    stamp: int
    source: str

    @property
    def ends(self) -> tuple[int, int] | None:
        """The two stamps of a relative measurement."""
        return None


@dataclass(frozen=True, slots=True, eq=False)
class Constant(Measurement):
    """What holds at all times: it waits for nothing, and its stamp says nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class StaticTransform(Constant):
    """Where a sensor sits: `parent_T_child` (from /tf_static)."""

    parent: str
    child: str
    pose: Array  # (7,)


def frozen(values: ArrayLike) -> Array:
    """A read-only float64 copy: frozen records mean frozen arrays."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def stamp_of(message: Message) -> int:
    """The header stamp of a ROS message, in nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def format_stamp(stamp: int) -> str:
    """`<sec>.<nsec>` with nine digits: exact, unlike a float of seconds."""
    sign, stamp = ("-", -stamp) if stamp < 0 else ("", stamp)
    return f"{sign}{stamp // SECOND}.{stamp % SECOND:09d}"


def parse_stamp(text: str) -> int:
    """The inverse of `format_stamp`; fewer than nine digits are padded on the right. ValueError if it is none."""
    seconds, _, fraction = text.partition(".")
    if not seconds.isdigit() or (fraction and not fraction.isdigit()) or len(fraction) > 9:
        raise ValueError(f"'{text}' is not a stamp of the form <sec>.<nsec>")
    return int(seconds) * SECOND + int(fraction.ljust(9, "0"))


def seven_of(pose: Message) -> Array:
    """geometry_msgs/Pose to x y z qx qy qz qw."""
    p, q = pose.position, pose.orientation
    return frozen((p.x, p.y, p.z, q.x, q.y, q.z, q.w))


def parse_frame(text: str) -> tuple[str, int | None]:
    """Split `<frame>@<sec>.<nsec>` into the frame and its stamp (None without `@`)."""
    frame, at, stamp = text.partition("@")
    return frame.lstrip("/"), parse_stamp(stamp) if at else None


Decoder = Callable[[Message, str], Measurement | Iterable[Measurement]]  # (message, source)


@dataclass(frozen=True, slots=True, eq=False)
class ImuSample(Measurement):
    """rate: (3,) rad/s, acceleration: (3,) m/s^2, gravity included (at rest it points up); both in the sensor's frame.

    Covariances: (9,) of one sample, row by row; zeros, or -1 at the first place, where the message has none.
    """

    frame: str
    rate: Array
    acceleration: Array
    rate_covariance: Array
    acceleration_covariance: Array
