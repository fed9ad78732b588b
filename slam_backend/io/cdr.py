"""Bytes to measurements: the one decoder, of live topics, bags and journals alike.

Every type goes through rosbags' typestore and the decoder of its sensor. Odometry-like messages, which come by the
hundred per second, have a shorter way that reads the bytes in place; whatever looks odd there takes the long one.
CDR: each number lies at a multiple of its size, counted from the end of the 4-byte encapsulation header.
"""

import struct
from collections.abc import Callable, Iterable, Mapping
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from ..core import command
from ..core.errors import BadMessage
from ..core.firewall.rules import OVERSIZE, RULES
from ..core.graph import Decision
from ..core.measurement import SECOND, Array, ImuSample, Measurement, parse_frame
from ..core.sensors import SENSORS
from ..core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from ..core.sensors.relative import RelativePose
from . import events
from .records import Record

Outcome = Measurement | Decision

_HEAD = Struct("<HxxiI").unpack_from  # encapsulation, seconds, nanoseconds
_LENGTH = Struct("<I").unpack_from
_LITTLE_ENDIAN = 0x0100  # the bytes 00 01
_NAMES_AT = 12  # where the frame id begins; eight bytes of stamp lie before it
_HEADER = "std_msgs/msg/Header"
_F8 = np.dtype("<f8")
_REMEMBERED, _LONG = 4096, 512  # entries at most; bytes from which on names are not worth remembering

# what the typestore and the sensors' decoders raise on bytes or fields that make no sense
_NONSENSE = (
    BadMessage, SerdeError, struct.error, ValueError, TypeError, LookupError, AttributeError, ArithmeticError,
    AssertionError, MemoryError, RecursionError,
)  # fmt: skip


_Slow = Callable[[Any, str], Measurement | Iterable[Outcome]]  # (message, source)
DECODERS: Mapping[str, Mapping[str, _Slow]] = {  # kind of a source -> type -> the long way
    **{kind: sensor.decoders for kind, sensor in SENSORS.items()},
    "command": command.DECODERS,
    "session": events.DECODERS,
}


class _Names(dict[bytes, tuple[str, ...]]):
    """The names that stand between stamp and numbers, by their bytes: they repeat from message to message."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count = count

    def __missing__(self, raw: bytes) -> tuple[str, ...]:
        """ValueError or struct.error unless the bytes are `count` strings and the padding up to the numbers."""
        names, at = [], 0
        for _ in range(self.count):
            at += -at % 4
            begin, at = at + 4, at + 4 + _LENGTH(raw, at)[0]
            if not raw[begin:at].endswith(b"\0"):
                raise ValueError("a string without its final zero")
            names.append(raw[begin : at - 1].decode())
        if at + -at % 8 != len(raw):
            raise ValueError("an odd length")
        if len(self) >= _REMEMBERED:
            self.clear()
        found = tuple(names)
        if len(raw) < _LONG:
            self[raw] = found
        return found


def _read(data: bytes, count: int, names: _Names) -> tuple[int, tuple[str, ...], Array]:
    """Stamp, names, and the `count` float64 that end the message."""
    encapsulation, seconds, nanoseconds = _HEAD(data, 0)
    if encapsulation != _LITTLE_ENDIAN:
        raise ValueError("not plain little-endian CDR")
    at = len(data) - 8 * count
    return seconds * SECOND + nanoseconds, names[data[_NAMES_AT:at]], np.frombuffer(data, _F8, count, at)


def _odometry(data: bytes, source: str, names: _Names) -> OdometryPose:
    """nav_msgs/msg/Odometry: pose 7, covariance 36, twist 6, covariance 36."""
    stamp, (frame, child), n = _read(data, 85, names)
    return OdometryPose(stamp, source, frame, child, n[:7], n[7:43], n[43:49], n[49:])


def _pose_with_covariance(data: bytes, source: str, names: _Names) -> OdometryPose:
    stamp, (frame,), n = _read(data, 43, names)
    return OdometryPose(stamp, source, frame, "", n[:7], n[7:], STILL, UNKNOWN)


def _pose(data: bytes, source: str, names: _Names) -> OdometryPose:
    stamp, (frame,), n = _read(data, 7, names)
    return OdometryPose(stamp, source, frame, "", n, UNKNOWN, STILL, UNKNOWN)


def _imu(data: bytes, source: str, names: _Names) -> ImuSample:
    """sensor_msgs/msg/Imu: orientation 4, covariance 9, angular velocity 3, covariance 9, acceleration 3, covariance 9."""
    stamp, (frame,), n = _read(data, 37, names)
    return ImuSample(stamp, source, frame, n[13:16], n[25:28], n[16:25], n[28:])


def _relative(data: bytes, source: str, names: _Names) -> RelativePose:
    """nav_msgs/msg/Odometry whose frames name two moments."""
    told = _odometry(data, source, names)
    frame_i, stamp_i = parse_frame(told.frame)
    frame_j, stamp_j = parse_frame(told.child)
    if stamp_i is None or stamp_j is None:
        raise ValueError("frames without a stamp")
    stamp = max(told.stamp, stamp_i, stamp_j)
    return RelativePose(stamp, source, stamp_i, stamp_j, frame_i, frame_j, told.pose, told.covariance)


_Fast = Callable[[bytes, str, _Names], Measurement]
_FAST: Mapping[tuple[str, str], tuple[_Fast, int]] = {  # (kind, type) -> the short way, number of names
    ("odometry", "nav_msgs/msg/Odometry"): (_odometry, 2),
    ("odometry", "geometry_msgs/msg/PoseWithCovarianceStamped"): (_pose_with_covariance, 1),
    ("odometry", "geometry_msgs/msg/PoseStamped"): (_pose, 1),
    ("relative", "nav_msgs/msg/Odometry"): (_relative, 2),
    ("imu", "sensor_msgs/msg/Imu"): (_imu, 1),
}


class _Route(NamedTuple):
    """How the messages of one topic are read; a way that is None does not exist."""

    type: str
    source: str
    fast: _Fast | None
    names: _Names
    slow: _Slow | None


def header_stamp(typestore: Typestore, record: Record) -> int | None:
    """Of a message that begins with a header, without decoding it; None of any other."""
    _, fields = typestore.fielddefs.get(record.type, ((), ()))
    if not fields or fields[0][1][1] != _HEADER or len(record.data) < _NAMES_AT:
        return None
    encapsulation, seconds, nanoseconds = _HEAD(record.data, 0)
    return int(seconds * SECOND + nanoseconds) if encapsulation == _LITTLE_ENDIAN else None


class Decoder:
    """Turns records into measurements, by a table: topic -> (source, kind of sensor)."""

    def __init__(self, typestore: Typestore, table: Mapping[str, tuple[str, str]]) -> None:
        self._typestore, self._table = typestore, table
        self._routes: dict[str, _Route] = {}

    def decode(self, record: Record) -> tuple[Outcome, ...]:
        """What the record says: nothing if its topic is not in the table, one Decision if it cannot be understood."""
        route = self._routes.get(record.topic)
        if route is None or route.type != record.type:
            if record.topic not in self._table:
                return ()
            route = self._route(record)
        if len(record.data) > OVERSIZE:
            size = float(len(record.data))
            return (
                _refused(record, route.source, "oversize", RULES["decode/oversize"].what, size, OVERSIZE),
            )
        data = (
            record.data if type(record.data) is bytes else bytes(record.data)
        )  # views of it must stay read-only
        if route.fast is not None:
            try:
                return (route.fast(data, route.source, route.names),)
            except (ValueError, struct.error):
                pass
        return self._decode(record, data, route)

    def _route(self, record: Record) -> _Route:
        source, kind = self._table[record.topic]
        slow = DECODERS.get(kind, {}).get(record.type)
        fast, count = _FAST.get((kind, record.type), (None, 0))
        route = _Route(record.type, source, fast, _Names(count), slow)
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


def _refused(
    record: Record,
    source: str,
    reason: str,
    detail: str,
    statistic: float | None = None,
    threshold: float | None = None,
) -> Decision:
    return Decision(
        record.log_time,
        f"{record.topic}@{record.log_time}",
        source,
        "refused",
        "decode",
        reason,
        f"{record.topic} ({record.type}): {detail}",
        statistic,
        threshold,
    )
