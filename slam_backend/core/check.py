"""The firewall: what a message tells alone (`checked`), and what needs its neighbours (`rechecked`).

Both are generators over a stream of measurements and decisions; what they refuse becomes a Decision.
Only what the configuration uses is judged: the axes of the space, and covariances that are read.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from math import dist, isfinite
from typing import Any

import numpy as np

from .config import Config
from .geometry import covariance_from_ros, covariance_to_ros, inverse_of, matrix_of, seven_of_matrix
from .graph import Decision, Verdict
from .measurement import SECOND, Array, Measurement, StaticTransform, format_stamp, frozen
from .sensors.landmark import LandmarkObservation, vertical
from .sensors.odometry import OdometryPose
from .sensors.pose import AbsolutePose
from .sensors.relative import RelativePose
from .space import SPACES, Space

Stream = Iterable[Measurement | Decision]

ABSURD_VARIANCE = 1e12  # m^2 or rad^2 on every used axis: a way to say "unknown"; no factor can come of it
FARTHEST = 1e9  # m; beyond, double precision has no micrometres left
QUATERNION_TOLERANCE = 0.1  # of the squared norm; less is normalized
ASYMMETRY = 1e-6  # relative to the largest entry
JITTER = 1.0  # m that a step may jump besides max_speed: odometry arrives in bursts


class Fault(Exception):  # never leaves this file: how a rule says why
    def __init__(
        self, reason: str, detail: str, statistic: float | None = None, threshold: float | None = None
    ) -> None:
        super().__init__(reason)
        self.reason, self.detail, self.statistic, self.threshold = reason, detail, statistic, threshold


def checked(items: Stream, config: Config) -> Iterator[Measurement | Decision]:
    """Refuse what cannot be right by itself."""
    space = SPACES[config.space]
    defaulted: set[str] = set()
    for item in items:
        rule = RULES.get(type(item))
        if rule is None or isinstance(item, Decision):
            yield item
            continue
        try:
            zero = rule(item, space, config.sources.get(item.source))
        except Fault as fault:
            yield _decide(item, "refused", "check", fault)
            continue
        if zero and item.source not in defaulted:
            defaulted.add(item.source)
            why = Fault("zero_covariance", "a variance of zero takes the configured default")
            yield replace(_decide(item, "accepted", "check", why), ends=None)  # of the source, not of a loop
        yield item


def rechecked(items: Stream, config: Config) -> Iterator[Measurement | Decision]:
    """After settling: refuse duplicate and teleporting messages of odometry sources.

    A jump that the next message confirms is a restart: the odometry's frame moved, the robot did not. From then on
    its poses are shifted so that the track goes on where it was.
    """
    tracks: dict[str, _Continuity] = {}
    for item in items:
        if isinstance(item, OdometryPose):
            source: Any = config.sources[item.source]
            track = tracks.setdefault(item.source, _Continuity(source.max_speed, SPACES[config.space]))
            yield from track.judge(item)
        else:
            yield item
    for track in tracks.values():
        yield from track.drop_doubt()


class _Continuity:
    """Of one odometry source: the last message believed, and a doubtful one that waits for the next."""

    def __init__(self, max_speed: float, space: Space) -> None:
        self._max_speed, self._space = max_speed, space
        self._unused = [axis for axis in range(6) if axis not in space.used]
        self._last: OdometryPose | None = None
        self._doubt: OdometryPose | None = None
        self._shift: Array | None = None  # (4, 4), old frame from new frame

    def judge(self, item: OdometryPose) -> Iterator[Measurement | Decision]:
        last, doubt = self._last, self._doubt
        duplicate = Fault("duplicate", "a second message with this stamp")
        if last is not None and item.stamp <= last.stamp:
            yield _decide(item, "refused", "recheck", duplicate)
        elif last is None or self._speeding(last, item) is None:
            yield from self.drop_doubt()
            self._last = item
            yield self._shifted(item)
        elif doubt is not None and item.stamp == doubt.stamp:  # no witness: it may be the same message again
            yield _decide(item, "refused", "recheck", duplicate)
        elif doubt is None or self._speeding(doubt, item) is not None:
            yield from self.drop_doubt()
            self._doubt = item
        else:
            why = Fault(
                "restart", "the odometry jumped and stayed there", self._speeding(last, item), self._max_speed
            )
            yield _decide(item, "accepted", "recheck", why)
            self._shift = self._matrix(self._shifted(last)) @ inverse_of(self._matrix(doubt))
            self._last, self._doubt = item, None
            yield self._shifted(doubt)
            yield self._shifted(item)

    def drop_doubt(self) -> Iterator[Decision]:
        if self._doubt is not None and self._last is not None:
            speed = self._speeding(self._last, self._doubt)
            why = Fault("teleport", "m/s since the last message is too fast", speed, self._max_speed)
            yield _decide(self._doubt, "refused", "recheck", why)
            self._doubt = None

    def _speeding(self, last: OdometryPose, item: OdometryPose) -> float | None:
        """The speed in m/s between two messages where it exceeds the bound."""
        n = self._space.point_dimension
        meters = dist(last.pose[:n].tolist(), item.pose[:n].tolist())
        seconds = max((item.stamp - last.stamp) / SECOND, 1e-9)
        return meters / seconds if meters > self._max_speed * seconds + JITTER else None

    def _shifted(self, item: OdometryPose) -> OdometryPose:
        if self._shift is None:
            return item
        before = self._matrix(item)
        after = self._shift @ before
        covariance = item.covariance.reshape(6, 6).copy()
        covariance[self._unused] = covariance[:, self._unused] = 0.0
        at_child = covariance_from_ros(covariance, before[:3, :3])
        turned = covariance_to_ros(at_child, after[:3, :3])
        return replace(item, pose=frozen(seven_of_matrix(after)), covariance=frozen(turned.reshape(36)))

    def _matrix(self, item: OdometryPose) -> Array:
        """(4, 4); what stands on axes that do not count, be it NaN, must not spread to those that do."""
        matrix = matrix_of(item.pose)
        if 2 in self._unused:
            matrix[2, 3] = 0.0
        return matrix


def _odometry(item: OdometryPose, space: Space, source: Any) -> bool:
    _stamp(item)
    _pose(item.pose, space)
    if source.noise == "twist":
        return _covariance(item.twist_covariance, space)
    if source.noise == "pose":
        return _covariance(item.covariance, space)
    return False


def _relative(item: RelativePose, space: Space, source: Any) -> bool:  # noqa: ARG001  # one signature for the table
    _stamp(item)
    _pose(item.pose, space)
    if item.stamp_i <= 0 or item.stamp_j <= 0:
        raise Fault("zero_stamp", "one of its two stamps is zero")
    if item.information is not None:
        _definite(item.information, "information")
        return False
    return _covariance(item.covariance, space)


def _static(item: StaticTransform, space: Space, source: Any) -> bool:  # noqa: ARG001
    _pose(item.pose, space)  # its stamp says nothing, and is often zero
    return False


def _absolute(item: AbsolutePose, space: Space, source: Any) -> bool:  # noqa: ARG001
    _stamp(item)
    _pose(item.pose, space)
    return _covariance(item.covariance, space)


def _landmark(item: LandmarkObservation, space: Space, source: Any) -> bool:  # noqa: ARG001
    _stamp(item)
    size = len(item.covariance)
    keep = [k for k in range(size) if space.name == "3d" or k != vertical(item.form)]
    if not all(isfinite(v) and abs(v) < FARTHEST for v in item.value[keep].tolist()):
        raise Fault("not_finite", "the observation holds NaN, infinity or more than 1e9")
    if item.form == "bearing_range" and item.value[-1] <= 0:
        raise Fault("range", "the range is not positive", float(item.value[-1]), 0.0)
    if item.form == "position" and not np.any(item.value[: space.point_dimension]):
        raise Fault("range", "the landmark is where the sensor is", 0.0, 0.0)
    return _said(_verdict_of_sighting(item.covariance.tobytes(), size, tuple(keep)))


def _stamp(item: Measurement) -> None:
    if item.stamp <= 0:
        raise Fault("zero_stamp", "the header has no stamp", float(item.stamp), 0.0)


def _pose(seven: Array, space: Space) -> None:
    x, y, z, qx, qy, qz, qw = seven.tolist()
    if space.name == "2d":
        z = 0.0
    square = qx * qx + qy * qy + qz * qz + qw * qw
    total = x + y + z + square
    if not isfinite(total) or max(abs(x), abs(y), abs(z)) > FARTHEST:
        raise Fault("not_finite", "the pose holds NaN, infinity or more than 1e9 m")
    if abs(square - 1) > QUATERNION_TOLERANCE:
        raise Fault("quaternion", "the quaternion is not of unit length", square, 1.0)


def _covariance(ros: Array, space: Space) -> bool:
    """Judge the used block; True when a variance of zero asks for the default."""
    return _said(_verdict(ros.tobytes(), space.used))


@lru_cache(maxsize=4096)  # robots repeat their covariances
def _verdict(raw: bytes, used: tuple[int, ...]) -> "bool | Fault":
    block = np.frombuffer(raw).reshape(6, 6)[np.ix_(used, used)]
    try:
        _judge(block)
    except Fault as fault:
        return fault
    return bool((np.diag(block) == 0).any())


@lru_cache(maxsize=4096)
def _verdict_of_sighting(raw: bytes, size: int, used: tuple[int, ...]) -> "bool | Fault":
    """The same, where NaN on the diagonal, too, asks for the default; False where no noise is stated at all."""
    block = np.frombuffer(raw).reshape(size, size)[np.ix_(used, used)]
    diagonal = np.diag(block)
    if np.isnan(diagonal).all() or not diagonal.any():
        return False
    unknown = np.isnan(diagonal)
    try:
        _judge(np.where(np.isnan(block) & (unknown[:, None] | unknown), 0.0, block))
    except Fault as fault:
        return fault
    return bool((diagonal == 0).any())


def _said(verdict: "bool | Fault") -> bool:
    if isinstance(verdict, Fault):
        raise verdict.with_traceback(None)  # else it would grow with each raise
    return verdict


def _judge(block: Array) -> None:
    diagonal = np.diag(block)
    if not np.isfinite(block).all():
        raise Fault("covariance_not_finite", "the covariance holds NaN or infinity")
    if (diagonal < 0).any():
        raise Fault("covariance_negative", "a variance is negative", float(diagonal.min()), 0.0)
    if (diagonal >= ABSURD_VARIANCE).all():
        raise Fault(
            "covariance_absurd", "every used variance says: unknown", float(diagonal.min()), ABSURD_VARIANCE
        )
    largest = float(np.abs(block).max())
    skew = float(np.abs(block - block.T).max())
    if skew > ASYMMETRY * largest:
        raise Fault("covariance_asymmetric", "the covariance is not symmetric", skew / largest, ASYMMETRY)
    known = diagonal > 0
    if block[~known].any():
        raise Fault("covariance_indefinite", "an axis with zero variance is correlated with another")
    if known.any():
        _definite(block[np.ix_(known, known)], "covariance")


def _definite(matrix: Array, what: str) -> None:
    """Positive definite, judged on the scale of each axis, since m^2 and rad^2 differ by decades."""
    diagonal = np.diag(matrix)
    if not np.isfinite(matrix).all():
        raise Fault(f"{what}_not_finite", f"the {what} holds NaN or infinity")
    if (diagonal <= 0).any():
        raise Fault(f"{what}_indefinite", f"the {what} is not positive definite", float(diagonal.min()), 0.0)
    scale = np.sqrt(diagonal)
    smallest = float(np.linalg.eigvalsh(matrix / scale[:, None] / scale)[0])
    if not smallest > 0:
        raise Fault(f"{what}_indefinite", f"the {what} is not positive definite", smallest, 0.0)


def _decide(item: Measurement, verdict: Verdict, stage: str, fault: Fault) -> Decision:
    return Decision(
        item.stamp, f"{item.source}/{format_stamp(item.stamp)}", item.source, verdict, stage,
        fault.reason, fault.detail, fault.statistic, fault.threshold, item.ends,
    )  # fmt: skip


RULES: dict[type, Callable[[Any, Space, Any], bool]] = {
    OdometryPose: _odometry,
    RelativePose: _relative,
    AbsolutePose: _absolute,
    LandmarkObservation: _landmark,
    StaticTransform: _static,
}
