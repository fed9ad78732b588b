"""What a sensor may know of the rest when it makes its factors."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .config import Earth
from .graph import UNTIL_JOINED, Decision, Delta, Estimate, Factor, Motion, Offer, Pose, Wait
from .inertial import Stretch
from .keyframes import Placed
from .measurement import Array
from .mounts import Mounts
from .space import Space


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The constants of a source, as configured or as calibrated.

    range_scale, distance_scale, turn_scale: how many times too large. distance_per_radian: m too many for each rad turned.
    turn_per_meter: rad too many to the left for each m ahead. time_offset: s to add to its stamps. mount: `frame_T_true`, of the
    sensor's frame; None: it sits where it is said to.
    """

    range_scale: float = 1.0
    distance_scale: float = 1.0
    turn_scale: float = 1.0
    distance_per_radian: float = 0.0
    turn_per_meter: float = 0.0
    time_offset: float = 0.0
    mount: Pose | None = None

    @property
    def is_faultless(self) -> bool:
        """Whether an odometry's motions are as told."""
        exact = self.distance_scale == self.turn_scale == 1.0
        return exact and self.distance_per_radian == self.turn_per_meter == 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """Read-only view of the back-end at one keyframe.

    guesses: first guesses of the variables of this change, which the estimate does not know yet.
    place: stamp -> nearest keyframe and the motion to the stamp; None where no odometry covers it.
    motion: (start, end) -> `start_T_end` by the driving source.
    landmark: name -> key. tag: the same, for one that is seen with its orientation; a name keeps its first key. component: key -> number of its connected component (None: not in the graph).
    waiting: key -> the measurements that wait for that variable.
    origin: latitude, longitude, altitude; None before the first fix.
    gauge: key -> id of the factor that holds its component and may be replaced; None where something else holds it, or will.
    has_datum: the earth stays where it is in the map.
    stretch: what the IMU measured from the keyframe before to this one. by_imu: nothing else tells the motion.
    kept: factor id -> whether it is in the graph. cameras: source -> what its CameraInfo says.
    memory: by source, what its sensor keeps from one keyframe to the next; a cache of what was offered, never of what is in the graph.
    """

    space: Space
    estimate: Estimate | None  # None at the first keyframe
    guesses: Mapping[int, Any]
    mounts: Mounts
    place: Callable[[int], Placed | None]
    motion: Callable[[int, int], Motion]
    landmark: Callable[[str], int]
    component: Callable[[int], int | None]
    waiting: Callable[[int], Sequence[Wait]] = lambda _: ()
    earth: Earth = field(default_factory=Earth)
    origin: Sequence[float] | None = None
    gauge: Callable[[int], str | None] = lambda _: None
    has_datum: bool = False
    stretch: Stretch | None = None
    by_imu: bool = False
    correction: Correction = Correction()
    kept: Callable[[str], bool] = lambda _: False
    cameras: Mapping[str, Any] = field(default_factory=dict)
    memory: dict[str, Any] = field(default_factory=dict)
    tag: Callable[[str], int] = lambda _: UNTIL_JOINED  # a graph file has none

    def known(self, key: int) -> bool:
        """Whether a variable is in the graph, or about to enter."""
        return key in self.guesses or self.component(key) is not None

    def apart(self, key: int, other: int) -> bool:
        """Whether the two are in components that nothing connects yet."""
        parts = self.component(key), self.component(other)
        return None not in parts and parts[0] != parts[1]

    def pose(self, key: int) -> Pose:
        guess = self.guesses.get(key)
        if guess is not None:
            return guess
        assert self.estimate is not None
        return self.estimate.pose(key)

    def point(self, key: int) -> Array:
        assert self.estimate is not None
        return self.estimate.point(key)

    def landing(self, stamp: int) -> Placed:
        """Where a measurement of that stamp lands; Unusable where no trajectory covers it."""
        placed = self.place(stamp)
        if placed is None:
            raise Unusable("uncovered", "no trajectory at its stamp")
        return placed

    def mount(self, frame: str) -> Pose:
        """`base_T_frame`: the space's own identity object for the base itself; Unusable for an unknown frame."""
        mount = self.mounts.get(frame)
        if mount is None:
            raise unknown_frame(frame)
        return mount if self.correction.mount is None else mount.compose(self.correction.mount)


def unknown_frame(frame: str) -> "Unusable":
    what = f"where is '{frame}' on the robot? add it to 'extrinsics' or send /tf_static"
    return Unusable("unknown_frame", what)


class Unusable(Exception):  # never leaves the sensors: how one says that a measurement makes no factor
    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.reason, self.detail = reason, detail


def each(window: Iterable[Offer], stage: str, make: Callable[[Offer], Factor | Wait]) -> Delta:
    """The Delta of a sensor whose measurements become one factor each; what is unusable becomes a Decision."""
    found: list[Factor] = []
    waits: list[Wait] = []
    decisions: list[Decision] = []
    for offer in window:
        try:
            made = make(offer)
        except Unusable as why:
            m = offer.measurement
            decisions.append(
                Decision(m.stamp, offer.id, m.source, "refused", stage, why.reason, why.detail, ends=m.ends)
            )
            continue
        if isinstance(made, Wait):
            waits.append(made)
        else:
            found.append(made)
    return Delta(tuple(found), waits=tuple(waits), decisions=tuple(decisions))


def pose_covariance(
    space: Space, ros: Array, pose: Pose, sigma_rotation: float, sigma_translation: float
) -> Array:
    """(36,) in ROS order to the tangent of `pose`; zero variances take the defaults before the axes are turned."""
    defaults = (sigma_translation**2,) * 3 + (sigma_rotation**2,) * 3
    return space.covariance(defaulted(ros.reshape(6, 6), defaults), pose)


def defaulted(covariance: Array, variances: Sequence[float]) -> Array:
    """A covariance whose zero or NaN variances are replaced by the configured ones."""
    known = [each > 0 for each in covariance.diagonal().tolist()]
    if all(known):
        return covariance
    kept = np.array(known)
    filled = np.where(kept[:, None] & kept, covariance, 0.0)
    filled[~kept, ~kept] = np.array(variances)[~kept]
    return filled
