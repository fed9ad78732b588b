"""Bytes to measurements: the one decoder, of live topics, bags and journals alike.

Every type goes through rosbags' typestore and the decoder of its sensor. Odometry-like messages, which come by the
hundred per second, have a shorter way that reads the bytes in place; whatever looks odd there takes the long one.
CDR: each number lies at a multiple of its size, counted from the end of the 4-byte encapsulation header.
"""

import struct
from collections.abc import Callable, Mapping
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from ..core.errors import BadMessage
from ..core.graph import Decision
from ..core.measurement import SECOND, Array, Measurement, parse_frame
from ..core.measurement import Decoder as SensorDecoder
from ..core.sensors import SENSORS
from ..core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from ..core.sensors.relative import RelativePose
from .records import Record

Outcome = Measurement | Decision

_HEAD = Struct("<HxxiII").unpack_from  # encapsulation, seconds, nanoseconds, length of the frame id
_LENGTH = Struct("<I").unpack_from
_LITTLE_ENDIAN = 0x0100  # the bytes 00 01
_F8 = np.dtype("<f8")
_TEXTS = 4096  # frame ids remembered at most

# what the typestore and the sensors' decoders raise on bytes or fields that make no sense
_NONSENSE = (
    BadMessage, SerdeError, struct.error, ValueError, TypeError, LookupError, AttributeError, ArithmeticError,
    AssertionError, MemoryError, RecursionError,
)  # fmt: skip


class _Texts(dict[bytes, str]):
    """Strings by their bytes with the final zero; frame ids repeat. ValueError if they are none."""

    def __missing__(self, raw: bytes) -> str:
        if not raw.endswith(b"\0"):
            raise ValueError("a string without its final zero")
        if len(self) >= _TEXTS:
            self.clear()
        text = self[raw] = raw[:-1].decode()
        return text


def _numbers(data: bytes, after: int, count: int) -> Array:
    """The `count` float64 that end the message, `after` the given byte. ValueError if it does not end there."""
    at = after + (4 - after) % 8
    if not 0 <= len(data) - at - 8 * count <= 3:  # up to three bytes of padding
        raise ValueError("an odd length")
    return np.frombuffer(data, _F8, count, at)


def _header(data: bytes) -> tuple[int, int]:
    """Stamp, and where the frame id ends; it begins at byte 16."""
    encapsulation, seconds, nanoseconds, length = _HEAD(data, 0)
    if encapsulation != _LITTLE_ENDIAN:
        raise ValueError("not plain little-endian CDR")
    return seconds * SECOND + nanoseconds, 16 + length


def _odometry(data: bytes, source: str, texts: _Texts) -> OdometryPose:
    """nav_msgs/msg/Odometry: 85 numbers after the child frame: pose 7, covariance 36, twist 6, covariance 36."""
    stamp, end = _header(data)
    at = end + -end % 4
    child_end = at + 4 + _LENGTH(data, at)[0]
    n = _numbers(data, child_end, 85)
    return OdometryPose(
        stamp, source, texts[data[16:end]], texts[data[at + 4 : child_end]], n[:7], n[7:43], n[43:49], n[49:]
    )


def _pose_with_covariance(data: bytes, source: str, texts: _Texts) -> OdometryPose:
    stamp, end = _header(data)
    n = _numbers(data, end, 43)
    return OdometryPose(stamp, source, texts[data[16:end]], "", n[:7], n[7:], STILL, UNKNOWN)


def _pose(data: bytes, source: str, texts: _Texts) -> OdometryPose:
    stamp, end = _header(data)
    return OdometryPose(
        stamp, source, texts[data[16:end]], "", _numbers(data, end, 7), UNKNOWN, STILL, UNKNOWN
    )


def _relative(data: bytes, source: str, texts: _Texts) -> RelativePose:
    """nav_msgs/msg/Odometry whose frames name two moments."""
    told = _odometry(data, source, texts)
    frame_i, stamp_i = parse_frame(told.frame)
    frame_j, stamp_j = parse_frame(told.child)
    if stamp_i is None or stamp_j is None:
        raise ValueError("frames without a stamp")
    stamp = max(told.stamp, stamp_i, stamp_j)
    return RelativePose(stamp, source, stamp_i, stamp_j, frame_i, frame_j, told.pose, told.covariance)


_FAST: Mapping[tuple[str, str], Callable[[bytes, str, _Texts], Measurement]] = {
    ("odometry", "nav_msgs/msg/Odometry"): _odometry,
    ("odometry", "geometry_msgs/msg/PoseWithCovarianceStamped"): _pose_with_covariance,
    ("odometry", "geometry_msgs/msg/PoseStamped"): _pose,
    ("relative", "nav_msgs/msg/Odometry"): _relative,
}


class _Route(NamedTuple):
    """How the messages of one topic are read; a way that is None does not exist."""

    type: str
    source: str
    fast: Callable[[bytes, str, _Texts], Measurement] | None
    slow: SensorDecoder | None


class Decoder:
    """Turns records into measurements, by a table: topic -> (source, kind of sensor)."""

    def __init__(self, typestore: Typestore, table: Mapping[str, tuple[str, str]]) -> None:
        self._typestore, self._table = typestore, table
        self._routes: dict[str, _Route] = {}
        self._texts = _Texts()

    def decode(self, record: Record) -> tuple[Outcome, ...]:
        """What the record says: nothing if its topic is not in the table, one Decision if it cannot be understood."""
        route = self._routes.get(record.topic)
        if route is None or route.type != record.type:
            if record.topic not in self._table:
                return ()
            route = self._route(record)
        data = (
            record.data if type(record.data) is bytes else bytes(record.data)
        )  # views of it must stay read-only
        if route.fast is not None:
            try:
                return (route.fast(data, route.source, self._texts),)
            except (ValueError, struct.error):
                pass
        return self._decode(record, data, route)

    def _route(self, record: Record) -> _Route:
        source, kind = self._table[record.topic]
        slow = SENSORS[kind].decoders.get(record.type) if kind in SENSORS else None
        route = _Route(record.type, source, _FAST.get((kind, record.type)) if slow else None, slow)
        self._routes[record.topic] = route
        return route

    def _decode(self, record: Record, data: bytes, route: _Route) -> tuple[Outcome, ...]:
        """By the typestore and the sensor's own decoder."""
        if route.slow is None:
            kind = self._table[record.topic][1]
            return (
                _refused(
                    record, route.source, "unknown_type", f"a source of kind '{kind}' has no such messages"
                ),
            )
        try:
            message: Any = self._typestore.deserialize_cdr(data, record.type)
            with np.errstate(all="ignore"):  # absurd numbers are for the firewall to judge, not for a warning
                made = route.slow(message, route.source)
                return (made,) if isinstance(made, Measurement) else tuple(made)
        except _NONSENSE as error:
            return (_refused(record, route.source, "bad_message", _line(error)),)


def _line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, BadMessage | SerdeError) else f"{type(error).__name__}: {text}"


def _refused(record: Record, source: str, reason: str, detail: str) -> Decision:
    return Decision(
        record.log_time,
        f"{record.topic}@{record.log_time}",
        source,
        "refused",
        "decode",
        reason,
        f"{record.topic} ({record.type}): {detail}",
    )
