"""The vocabulary between sensors, robust stages and solvers: keyframes, factors, deltas, decisions."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, Protocol

import gtsam
from gtsam.symbol_shorthand import L, X

from .measurement import Array, Measurement, format_stamp

Pose = Any  # gtsam.Pose2 or gtsam.Pose3: the same methods, no common base
Verdict = Literal["accepted", "probation", "refused", "removed", "restored"]


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A moment that has a pose variable in the graph. `index` counts in order of creation, not of stamp."""

    index: int
    stamp: int  # ns
    pose: int  # the key X(index)


FIRST = int(X(0))  # gtsam counts a symbol's index up from there


def keyframe(index: int, stamp: int) -> Keyframe:
    return Keyframe(index, stamp, FIRST + index)


EARTH = int(gtsam.symbol("e", 0))  # east, north, up at an origin, in the map: see sensors/gnss.py
HOLDING = frozenset(
    {"gauge", "datum"}
)  # kinds of factors that only say where the map lies: no part of a cost
DATUM = "datum/0.000000000/0"  # id of the factor that holds it, where that holds the map


def landmark_key(index: int) -> int:
    return int(L(index))


def tag_key(index: int) -> int:
    return int(gtsam.symbol("t", index))


def is_pose(key: int) -> bool:
    return key >> 56 == ord("x")  # gtsam keeps a symbol's letter in the top byte


class Offer(NamedTuple):
    """A measurement on its way into the graph. `motion`: it made a keyframe, so it must enter."""

    id: str
    measurement: Measurement
    motion: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """A GTSAM factor and where it came from; the id is the same in every replay.

    id: `<source>/<stamp>/<n>`, n counting the measurements of that source with that stamp.
    kind: motion (it made a keyframe), odometry (beside that), loop, landmark, range (between two poses), pose, imu, floor, gnss, earth, datum or gauge; what
    reports, robust stages and exports sort by.
    stamp: of the measurement; stamps: of its two ends, for relative measurements.
    motion: between its first pose and its last, where the factor itself has more variables than these.
    """

    id: str
    kind: str
    factor: Any  # a gtsam.NonlinearFactor
    keys: tuple[int, ...]
    stamp: int
    stamps: tuple[int, int] | None = None
    motion: "Motion | None" = None

    @property
    def source(self) -> str:
        return self.id.partition("/")[0]


def rekeyed(factor: Factor, old: int, new: int) -> Factor:
    """The same measurement, of another variable."""
    keys = tuple(new if key == old else key for key in factor.keys)
    return replace(factor, factor=factor.factor.rekey(list(keys)), keys=keys)


UNTIL_JOINED = 0  # no variable has this key


@dataclass(frozen=True, slots=True, eq=False)
class Wait:
    """A measurement that cannot be used before a variable exists; taken up again when it does."""

    offer: Offer
    until: int  # key; UNTIL_JOINED: until two components become one
    reason: str
    seen: "Seen | None" = None  # what it would say about how the two components lie


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A landmark of one component, seen from a pose of another: where, from that pose."""

    pose: int
    landmark: int
    point: Array | Pose  # of a tag its pose


@dataclass(frozen=True, slots=True)
class Decision:
    """What became of a record or a factor, why, and on what it rested.

    verdict, stage, reason: `stage/reason` is the rule; `detail` a sentence for people.
    statistic, threshold: the number that was compared, where there was one.
    basis: what else it rested on, by name: plain numbers, texts, lists and mappings.
    """

    stamp: int
    id: str
    source: str
    verdict: Verdict
    stage: str
    reason: str
    detail: str = ""
    statistic: float | None = None
    threshold: float | None = None
    ends: tuple[int, int] | None = None  # the two stamps of a relative measurement
    count: int = 1  # how many records of one second it stands for
    basis: Mapping[str, Any] = field(default_factory=dict, hash=False)


@dataclass(frozen=True, slots=True, eq=False)
class Delta:
    """A change to the graph as one value: applied whole or not at all.

    values: first guess of each new variable; for a variable that exists, where to move it.
    waits, decisions: measurements that could not become factors now, and what was decided about them.
    """

    add: tuple[Factor, ...] = ()
    remove: tuple[str, ...] = ()
    values: Mapping[int, Any] = field(default_factory=dict)
    waits: tuple[Wait, ...] = ()
    decisions: tuple[Decision, ...] = ()

    def __add__(self, other: "Delta") -> "Delta":
        return Delta(
            self.add + other.add,
            self.remove + other.remove,
            {**self.values, **other.values},
            self.waits + other.waits,
            self.decisions + other.decisions,
        )

    def __bool__(self) -> bool:
        return bool(self.add or self.remove or self.values)


class Estimate(Protocol):
    """What the solver believes now; everything is computed when asked."""

    def pose(self, key: int) -> Pose: ...

    def point(self, key: int) -> Array: ...

    def value(self, key: int) -> Any:
        """Of any variable, as its kind is (variables.py)."""
        ...

    def knows(self, key: int) -> bool: ...

    def values(self) -> gtsam.Values:
        """Every variable; costs time in proportion to the graph."""
        ...

    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint covariance in the order of `keys`, each block at the tangent of its variable. SolverFailure if singular."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """`a_T_b` with its covariance at the tangent of b, in the dimension of the space."""

    pose: Pose
    covariance: Array

    def then(self, other: "Motion") -> "Motion":
        """`a_T_c` from `a_T_b` and `b_T_c`, as independent measurements."""
        adjoint = other.pose.inverse().AdjointMap()
        return Motion(self.pose.compose(other.pose), adjoint @ self.covariance @ adjoint.T + other.covariance)

    def inverse(self) -> "Motion":
        """`b_T_a`, its covariance moved to the tangent of a."""
        adjoint = self.pose.AdjointMap()
        return Motion(self.pose.inverse(), adjoint @ self.covariance @ adjoint.T)


def identify(measurement: Measurement, n: int) -> str:
    return f"{measurement.source}/{format_stamp(measurement.stamp)}/{n}"


def total(deltas: Iterable[Delta]) -> Delta:
    """The sum of many deltas, in time linear in their content."""
    add: list[Factor] = []
    remove: list[str] = []
    values: dict[int, Any] = {}
    waits: list[Wait] = []
    decisions: list[Decision] = []
    for delta in deltas:
        add += delta.add
        remove += delta.remove
        values.update(delta.values)
        waits += delta.waits
        decisions += delta.decisions
    return Delta(tuple(add), tuple(remove), values, tuple(waits), tuple(decisions))
