"""Names to answers, of a finished run and of a living one alike.

    pose@<t>            map_T_base: x y z qx qy qz qw
    pose@<t>#cov        its covariance, 6x6 in ROS order: x y z, then rotations about the axes of the map
    between@<a>,<b>     a_T_b: x y z qx qy qz qw
    velocity@<t>        x y z in the map, m/s: of a run with an IMU, linearly between keyframes
    bias@<t>            of the IMU, in its frame: accelerometer x y z (m/s^2), gyroscope x y z (rad/s)
    landmark/<id>       x y z in the map; of a tag with an orientation also qx qy qz qw
    earth               how the map lies on the earth, or why that is not known yet: see core/georeference.py
    place@<t>           of the robot: latitude, longitude (degrees WGS-84), altitude (m)
    place/<id>          of a landmark
    decision/<factor>   the last decision about it
    map@<t>/<name>      any of these, as believed when everything up to t had been applied, and nothing later

<t>, <a>, <b> are moments: `<sec>.<nsec>`, `now` (the last keyframe) or `k<keyframe index>`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from .config import OdometrySource
from .errors import BadConfig, SlamError, SolverFailure
from .geometry import covariance_to_ros, inverse_of, matrix_of, rotation_of, seven_of_matrix
from .georeference import Georeference
from .graph import Motion
from .keyframes import Track
from .measurement import Array, format_stamp, parse_stamp
from .sensors.gnss import geodetic
from .space import Space
from .trajectory import Stamps, States, Trajectory, shaped

FORMS = (
    "pose@<t>", "pose@<t>#cov", "between@<a>,<b>", "velocity@<t>", "bias@<t>", "landmark/<id>", "earth", "place@<t>", "place/<id>",
    "decision/<factor>", "map@<t>/<any of these>",
)  # fmt: skip
PAST = "map@"  # what a name begins with that asks for an earlier belief
MOMENTS = "<sec>.<nsec>, now or k<keyframe index>"
GTSAM_AXES = {3: (3, 4, 2), 6: (0, 1, 2, 3, 4, 5)}  # of a tangent with so many, in GTSAM's order of six


class Known(Protocol):
    """What is asked. Each part is taken only when a name needs it.

    trajectory: the keyframes. indices: (N,) theirs. odometry: from the same start. noise: of the odometry, between keyframes.
    """

    @property
    def space(self) -> Space: ...

    @property
    def noise(self) -> OdometrySource: ...

    @property
    def trajectory(self) -> Trajectory: ...

    @property
    def indices(self) -> Stamps: ...

    @property
    def odometry(self) -> Trajectory: ...

    @property
    def landmarks(self) -> Mapping[str, Array]: ...

    @property
    def orientations(self) -> Mapping[str, Array]: ...

    @property
    def states(self) -> States: ...

    @property
    def earth(self) -> Georeference | None: ...

    def covariance(self, index: int) -> Array:
        """Of a keyframe's pose, at its tangent. SolverFailure if it is not determined."""
        ...

    def decision(self, identifier: str) -> Mapping[str, Any] | None: ...

    def past(self, stamp: int) -> "Known":
        """As believed when everything up to a stamp had been applied, and nothing later. Unknown where that cannot be told."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """value: (7,), (6, 6), (3,) or (6,) numbers, or the fields of a decision or of the earth; None: unknown, and `why`."""

    name: str
    value: Array | Mapping[str, Any] | None
    why: str = ""


@dataclass(frozen=True, slots=True)
class Moment:
    """A stamp (ns), or the index of a keyframe; None and None: now."""

    stamp: int | None = None
    index: int | None = None


class Question(NamedTuple):
    name: str
    kind: str  # pose, cov, between, velocity, bias, landmark, earth, place or decision
    moments: tuple[Moment, ...] = ()
    identifier: str = ""
    past: Moment | None = None  # when it was believed; None: the newest belief


class Unknown(SlamError):
    """A name that is well formed and has no answer; the text says why."""


def question(name: str) -> Question:
    """BadConfig if the name has none of FORMS."""
    when, slash, asked = name.removeprefix(PAST).partition("/")
    if name.startswith(PAST) and slash:
        return _question(name, asked)._replace(past=moment_of(name, when))
    return _question(name, name)


def _question(name: str, asked: str) -> Question:
    """asked: the name without its beginning, which says when it was believed."""
    if asked == "earth":
        return Question(name, asked)
    kind, slash, identifier = asked.partition("/")
    if slash and identifier and kind in ("landmark", "place", "decision"):
        return Question(name, kind, identifier=identifier)
    kind, at, rest = asked.partition("@")
    when, hash_, what = rest.partition("#")
    moments = when.split(",")
    if at and kind == "pose" and len(moments) == 1 and what == ("cov" if hash_ else ""):
        return Question(name, what or kind, (moment_of(name, when),))
    if at and kind in ("velocity", "bias", "place") and len(moments) == 1 and not hash_:
        return Question(name, kind, (moment_of(name, when),))
    if at and kind == "between" and len(moments) == 2 and not hash_:
        return Question(name, kind, tuple(moment_of(name, text) for text in moments))
    raise BadConfig(f"'{name}' is none of {', '.join(FORMS)}")


def answers(names: Sequence[str], known: Known) -> list[Answer]:
    """One for each name, in their order. BadConfig, before anything is looked up, if one of them is malformed."""
    questions = [question(name) for name in names]
    found: dict[str, Answer] = {}
    for then, group in _by_belief(questions, known):
        if isinstance(then, Unknown):
            found |= {each.name: Answer(each.name, None, str(then)) for each in group}
            continue
        poses = _poses({moment for each in group for moment in each.moments}, then)
        found |= {each.name: _answer(each, then, poses) for each in group}
    return [found[name] for name in names]


def _by_belief(
    questions: Sequence[Question], known: Known
) -> Iterator[tuple[Known | Unknown, Sequence[Question]]]:
    """The questions by what they are asked of; earlier beliefs in order of stamp, so that one way through the past serves all."""
    if present := [each for each in questions if each.past is None]:
        yield known, present
    by_stamp: dict[int, list[Question]] = {}
    for each in questions:
        if each.past is not None:
            try:
                by_stamp.setdefault(believed_at(each.past, known), []).append(each)
            except Unknown as why:
                yield why, [each]
    for stamp in sorted(by_stamp):
        try:
            then = known.past(stamp)
        except Unknown as why:
            yield why, by_stamp[stamp]
        else:
            yield then, by_stamp[stamp]


def believed_at(moment: Moment, known: Known) -> int:
    """The stamp (ns) of `map@<moment>`; it may lie outside the trajectory."""
    return _stamp(moment, known) if moment.stamp is None else moment.stamp


def moment_of(name: str, text: str) -> Moment:
    """BadConfig, with the name that it stands in, if the text is none."""
    if text == "now":
        return Moment()
    try:
        if text[:1] == "k" and text.isascii() and text[1:].isdigit():
            return Moment(index=int(text[1:]))
        return Moment(stamp=parse_stamp(text))
    except ValueError:
        raise BadConfig(f"'{name}': '{text}' is no moment: write {MOMENTS}") from None


Posed = tuple[int, Array]  # stamp and pose (7,)


def _poses(moments: set[Moment], known: Known) -> dict[Moment, Posed | Unknown]:
    """All moments in one interpolation; the odometry is not even read where keyframes answer."""
    found: dict[Moment, Posed | Unknown] = {}
    stamps: dict[Moment, int] = {}
    for moment in moments:
        try:
            stamps[moment] = _stamp(moment, known)
        except Unknown as why:
            found[moment] = why
    if stamps:
        wanted = np.array(list(stamps.values()), dtype=np.int64)
        keyframes = known.trajectory
        exact = np.isin(wanted, keyframes.stamps).all()
        sevens = keyframes.at(wanted) if exact else shaped(keyframes, known.odometry, wanted)
        found |= dict(zip(stamps, zip(wanted.tolist(), sevens, strict=True), strict=True))
    return found


def _stamp(moment: Moment, known: Known) -> int:
    stamps = known.trajectory.stamps
    if not len(stamps):
        raise Unknown("there is no keyframe yet")
    if moment.index is not None:
        rows = np.flatnonzero(known.indices == moment.index)
        if not len(rows):
            raise Unknown(f"there is no keyframe k{moment.index}; the last is k{known.indices.max()}")
        return int(stamps[rows[0]])
    first, last = int(stamps[0]), int(stamps[-1])
    stamp = last if moment.stamp is None else moment.stamp
    if known.trajectory.between_sessions(np.array([stamp]))[0]:
        raise Unknown(f"{format_stamp(stamp)} lies between two sessions")
    if not first <= stamp <= last:
        span = f"{format_stamp(first)} to {format_stamp(last)}"
        raise Unknown(f"{format_stamp(stamp)} lies outside the trajectory, {span}")
    return stamp


def _answer(asked: Question, known: Known, poses: Mapping[Moment, Posed | Unknown]) -> Answer:
    try:
        return Answer(asked.name, _value(asked, known, [_posed(poses[each]) for each in asked.moments]))
    except (Unknown, SolverFailure) as why:
        return Answer(asked.name, None, str(why))


def _posed(found: Posed | Unknown) -> Posed:
    if isinstance(found, Unknown):
        raise found
    return found


def _value(asked: Question, known: Known, poses: Sequence[Posed]) -> Array | Mapping[str, Any]:
    if poses:
        return _when(asked, known, poses)
    if asked.kind == "landmark":
        return np.append(_landmark(asked, known), known.orientations.get(asked.identifier, ()))
    if asked.kind == "earth":
        return _earth(known).as_json()
    if asked.kind == "place":
        return _place(_landmark(asked, known), _earth(known))
    if (decision := known.decision(asked.identifier)) is None:
        raise Unknown(f"nothing was decided about '{asked.identifier}' (ids are <source>/<sec>.<nsec>/<n>)")
    return decision


def _when(asked: Question, known: Known, poses: Sequence[Posed]) -> Array:
    """What has a stamp."""
    stamp, seven = poses[0]
    if asked.kind == "cov":
        return covariance_at(known, stamp, seven)
    if asked.kind == "place":
        return _place(seven[:3], _earth(known))
    if asked.kind == "between":
        a, b = (matrix_of(seven) for _, seven in poses)
        return seven_of_matrix(inverse_of(a) @ b)
    if asked.kind in ("velocity", "bias"):
        if (found := known.states.at(stamp, known.trajectory.stamps)) is None:
            raise Unknown(f"no velocity and no bias is estimated at {format_stamp(stamp)}: no IMU reaches it")
        return found[:3] if asked.kind == "velocity" else found[3:]
    return seven


def _landmark(asked: Question, known: Known) -> Array:
    if (point := known.landmarks.get(asked.identifier)) is None:
        raise Unknown(f"there is no landmark '{asked.identifier}' among {len(known.landmarks)}")
    return point


def _earth(known: Known) -> Georeference:
    if known.earth is None:
        raise Unknown("there is no source of kind gnss: nothing tells how the map lies on the earth")
    return known.earth


def _place(point: Array, earth: Georeference) -> Array:
    """(3,) m in the map to latitude, longitude, altitude."""
    if earth.pose is None or earth.origin is None:
        raise Unknown(f"the map has no place on the earth yet: {earth.why}")
    return geodetic(earth.on_earth(point), earth.origin)


def covariance_at(known: Known, stamp: int, seven: Array) -> Array:
    """(6, 6) in ROS order, of the pose `seven` at a stamp within the keyframes.

    At a keyframe its marginal covariance. Between two, that of the nearer one (by distance moved, then angle, then time),
    carried along the motion from there, and the noise that the odometry's model gives this motion added as if it
    were independent. The keyframe beyond is left out, so this is an upper bound, and the nearer the tighter; it does not
    use covariances that the messages stated, which a run does not keep.
    """
    space, keyframes = known.space, known.trajectory
    pose = space.pose(seven.tolist())
    right = int(np.searchsorted(keyframes.stamps, stamp))
    beside = [right] if keyframes.stamps[right] == stamp else [right - 1, right]

    def distance(row: int) -> tuple[float, float, int]:
        near = space.pose(keyframes.sevens[row].tolist())
        return *space.size(near.between(pose)), abs(stamp - int(keyframes.stamps[row]))

    row = min(beside, key=distance)
    tangent = known.covariance(int(known.indices[row]))
    if len(beside) > 1:
        start, near = int(keyframes.stamps[row]), space.pose(keyframes.sevens[row].tolist())
        track = Track(space, known.noise.model_copy(update={"noise": "model"}))
        track.add(start, near)
        track.add(stamp, pose)
        tangent = Motion(near, tangent).then(track.motion(start, stamp)).covariance
    full, axes = np.zeros((6, 6)), GTSAM_AXES[space.dimension]
    full[np.ix_(axes, axes)] = tangent
    return covariance_to_ros(full, rotation_of(seven[3:]))
