"""Names and what they mean, asked of a small world that is known exactly."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
import pytest

from slam_backend.core.config import OdometrySource
from slam_backend.core.errors import BadConfig, BadFile, SolverFailure
from slam_backend.core.geometry import covariance_from_ros
from slam_backend.core.georeference import Georeference
from slam_backend.core.measurement import SECOND, Array
from slam_backend.core.query import FORMS, Answer, Moment, Unknown, answers, question
from slam_backend.core.space import SPACES
from slam_backend.core.trajectory import Stamps, States, Trajectory, shaped

NOISE = OdometrySource(noise="pose", sigma_translation_per_meter=0.1)
TURNED = [0.0, 0, np.sin(0.3), np.cos(0.3)]


def track(stamps: list[int], *positions: tuple[float, float, float]) -> Trajectory:
    return Trajectory(np.array(stamps, dtype=np.int64), np.array([[*p, *TURNED] for p in positions]))


@dataclass
class World:
    """Keyframes 0, 2, 1 at 1, 2 and 4 s; the odometry has one more sample, at 3.5 s, and swerves there."""

    name: str = "3d"
    noise: OdometrySource = NOISE
    indices: Stamps = field(default_factory=lambda: np.array([0, 2, 1], dtype=np.int64))
    landmarks: Mapping[str, Array] = field(default_factory=lambda: {"tag36h11:5": np.array([1.0, 2, 3])})
    orientations: Mapping[str, Array] = field(default_factory=dict)
    asked: list[int] = field(default_factory=list)
    states: States = field(
        default_factory=lambda: States(np.array([SECOND, 2 * SECOND]), np.arange(18.0).reshape(2, 9))
    )
    earth: Georeference | None = None

    @property
    def space(self) -> Any:
        return SPACES[self.name]

    @property
    def trajectory(self) -> Trajectory:
        return track([SECOND, 2 * SECOND, 4 * SECOND], (0, 0, 0), (1, 0, 0), (3, 0, 0))

    @property
    def odometry(self) -> Trajectory:
        s = [SECOND, 2 * SECOND, 7 * SECOND // 2, 4 * SECOND]
        return track(s, (0, 0, 0), (1, 0, 0), (2.5, 1, 0), (3, 0, 0))

    def covariance(self, index: int) -> Array:
        if index == 0:
            raise SolverFailure("keyframe 0 floats", ())
        return np.diag(np.arange(1.0, self.space.dimension + 1)) * 1e-4

    def decision(self, identifier: str) -> Mapping[str, Any] | None:
        return {"id": identifier, "verdict": "accepted"} if identifier == "loops/1.000000000/0" else None

    def past(self, stamp: int) -> "World":
        """Until 3 s the landmark was not known; before 1 s nothing was."""
        self.asked.append(stamp)
        if stamp < SECOND:
            raise Unknown("there was no keyframe yet")
        return World(landmarks={}) if stamp < 3 * SECOND else self


def one(name: str, world: World | None = None) -> Answer:
    return answers([name], world or World())[0]


def value(name: str, world: World | None = None) -> Any:
    found = one(name, world)
    assert found.value is not None, found.why
    return found.value


@pytest.mark.parametrize(
    ("text", "moment"),
    [
        ("1700000000.000000001", Moment(stamp=1_700_000_000_000_000_001)),
        ("1.5", Moment(stamp=1_500_000_000)),
        ("1.", Moment(stamp=SECOND)),
        ("12", Moment(stamp=12 * SECOND)),
        ("now", Moment()),
        ("k0", Moment(index=0)),
        ("k1734", Moment(index=1734)),
    ],
)
def test_a_moment_is_a_stamp_in_whole_nanoseconds_now_or_a_keyframe(text: str, moment: Moment) -> None:
    assert question(f"pose@{text}").moments == (moment,)
    assert question(f"pose@{text}#cov").moments == (moment,)
    assert question(f"between@{text},now").moments == (moment, Moment())


@pytest.mark.parametrize(
    "name",
    ["", "pose", "pos@1.0", "Pose@now", "pose@1.0,2.0", "pose@now#covariance", "pose@now#", "between@now", "pose/now",
     "between@1,2,3", "between@1,2#cov", "landmark/", "landmark", "decision/", "velocity@now#cov", "earth@now", "earth#cov", "earth/", "place", "place/",
     "place@now#cov", "place@1,2", "@now", "map@now",
     "map@now/", "map@1/map@2/pose@now", "map@1/pose", "map@1"],
)  # fmt: skip
def test_a_name_of_no_known_form_is_answered_with_the_forms(name: str) -> None:
    with pytest.raises(BadConfig) as raised:
        question(name)
    assert all(form in str(raised.value) for form in FORMS)
    assert f"'{name}'" in str(raised.value)


@pytest.mark.parametrize(
    "text", ["", "abc", "1.0000000001", "-1.0", "1e9", "k", "k-1", "k1.0", "Now", " 1", "²", "k²"]
)
def test_what_is_no_moment_is_quoted(text: str) -> None:
    for name in (f"pose@{text}", f"between@now,{text}"):
        with pytest.raises(BadConfig) as raised:
            question(name)
        assert f"'{text}' is no moment: write <sec>.<nsec>, now or k<keyframe index>" in str(raised.value)


def test_malformed_names_are_told_before_anything_is_looked_up() -> None:
    class Damaged(World):
        @property
        def trajectory(self) -> Trajectory:
            raise BadFile("damaged")

    with pytest.raises(BadConfig):
        answers(["pose@now", "nonsense"], Damaged())
    with pytest.raises(BadFile):
        answers(["pose@now"], Damaged())


def test_poses_of_keyframes_are_theirs_to_the_bit() -> None:
    world = World()
    for name, row in (
        ("pose@1", 0),
        ("pose@k2", 1),
        ("pose@4.000000000", 2),
        ("pose@now", 2),
        ("pose@k1", 2),
    ):
        np.testing.assert_array_equal(value(name, world), world.trajectory.sevens[row])


def test_between_keyframes_the_odometry_gives_the_shape() -> None:
    world = World()
    expected = shaped(world.trajectory, world.odometry, [7 * SECOND // 2])[0]
    np.testing.assert_array_equal(value("pose@3.5"), expected)
    np.testing.assert_allclose(value("pose@3.5")[:3], [2.5, 1, 0], atol=1e-12)


def test_keyframes_are_answered_without_reading_the_odometry() -> None:
    class Unread(World):
        @property
        def odometry(self) -> Trajectory:
            raise BadFile("must not be read")

    assert value("pose@now", Unread()).shape == (7,)
    with pytest.raises(BadFile):
        answers(["pose@3.5"], Unread())


def test_between_is_the_pose_of_the_second_in_the_first() -> None:
    def pose(name: str) -> Any:
        return SPACES["3d"].pose(value(name).tolist())

    found = SPACES["3d"].pose(value("between@1.25,3.5").tolist())
    assert found.equals(pose("pose@1.25").between(pose("pose@3.5")), 1e-12)
    np.testing.assert_allclose(value("between@now,k1"), [0, 0, 0, 0, 0, 0, 1], atol=1e-15)


@pytest.mark.parametrize("space", ["2d", "3d"])
def test_the_covariance_of_a_keyframe_is_its_marginal_in_ros_order(space: str) -> None:
    world = World(space)
    found = value("pose@now#cov", world)
    assert found.shape == (6, 6)
    pose = world.space.pose(world.trajectory.sevens[2].tolist())
    np.testing.assert_allclose(world.space.covariance(found, pose), world.covariance(1), atol=1e-16)
    if space == "2d":
        assert not found[[2, 3, 4]].any()
        assert not found[:, [2, 3, 4]].any()


def test_between_keyframes_the_nearer_ones_covariance_is_carried_and_the_motions_added() -> None:
    """At 3.5 s the last keyframe is 1.12 m off, the one before 1.8 m."""
    world = World()
    near = gtsam.Pose3(world.trajectory.poses[2])
    here = world.space.pose(value("pose@3.5").tolist())
    adjoint = here.between(near).AdjointMap()
    meters = np.linalg.norm(near.between(here).translation())
    floors = (world.noise.sigma_rotation_floor, world.noise.sigma_translation_floor)
    grown = [world.noise.sigma_rotation_per_meter**2 * meters + floors[0] ** 2] * 3
    grown += [world.noise.sigma_translation_per_meter**2 * meters + floors[1] ** 2] * 3
    # noise of the motion back from the keyframe lies at the tangent of the keyframe
    expected = adjoint @ (world.covariance(1) + np.diag(grown)) @ adjoint.T
    found = covariance_from_ros(value("pose@3.5#cov"), here.rotation().matrix())
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)


def test_what_is_not_known_is_said_and_the_others_are_answered() -> None:
    names = ["pose@0.5", "pose@now", "pose@4.000000001", f"pose@{10**30}", "pose@k3", "pose@k0#cov", "between@now,k9",
             "landmark/5", "landmark/tag36h11:5", "decision/loops/2.0/0", "decision/loops/1.000000000/0"]  # fmt: skip
    found = {answer.name: answer for answer in answers(names, World())}
    assert list(found) == names
    unknown = {name: answer.why for name, answer in found.items() if answer.value is None}
    assert set(names) - set(unknown) == {"pose@now", "landmark/tag36h11:5", "decision/loops/1.000000000/0"}
    assert "1.000000000 to 4.000000000" in unknown["pose@4.000000001"]
    assert "k3" in unknown["pose@k3"]
    assert unknown["pose@k0#cov"] == "keyframe 0 floats"
    assert "landmark '5'" in unknown["landmark/5"]
    assert "loops/2.0/0" in unknown["decision/loops/2.0/0"]
    np.testing.assert_array_equal(value("landmark/tag36h11:5"), [1, 2, 3])
    (tag,) = answers(["landmark/tag36h11:5"], World(orientations={"tag36h11:5": np.array(TURNED)}))
    np.testing.assert_array_equal(tag.value, [1, 2, 3, *TURNED])
    assert value("decision/loops/1.000000000/0")["verdict"] == "accepted"


def test_before_the_first_keyframe_nothing_is_known() -> None:
    class Nothing(World):
        @property
        def trajectory(self) -> Trajectory:
            return Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 7)))

    for name in ("pose@now", "pose@k0", "pose@1.0#cov", "between@now,now"):
        assert "no keyframe yet" in one(name, Nothing()).why


def test_a_name_may_ask_what_was_believed_at_another_moment() -> None:
    world = World()
    names = [
        "map@4/landmark/tag36h11:5",
        "map@2.5/landmark/tag36h11:5",
        "map@0.5/pose@now",
        "map@k0/pose@k1",
        "map@k9/pose@k1",
    ]
    known, unknown, before, first, never = answers(names, world)
    assert known.value is not None
    assert unknown.value is None
    assert before.why == "there was no keyframe yet"
    assert first.value is not None
    assert "no keyframe k9" in never.why
    assert world.asked == sorted(world.asked) == [SECOND // 2, SECOND, 5 * SECOND // 2, 4 * SECOND], (
        "one way through the past"
    )
    with pytest.raises(BadConfig, match="'now-ish' is no moment"):
        question("map@now-ish/pose@now")


def test_velocity_and_bias_are_told_where_an_imu_reaches():
    """At a keyframe and, linearly, between two of them; not where one of the two has none."""
    at, between, bias, beyond = answers(["velocity@1.0", "velocity@1.25", "bias@k2", "velocity@3.0"], World())
    np.testing.assert_array_equal(at.value, [0, 1, 2])
    np.testing.assert_allclose(between.value, [2.25, 3.25, 4.25])
    np.testing.assert_array_equal(bias.value, np.arange(12.0, 18))
    assert beyond.value is None
    assert "no IMU reaches it" in beyond.why


NORTH = np.array([10.0, 0, 5, 0, 0, -np.sin(np.pi / 4), np.cos(np.pi / 4)])  # the map's x axis points north


def test_the_earth_is_told_with_its_origin_and_places_in_degrees() -> None:
    """The map begins 10 m south of the origin, and 5 m below it."""
    world = World(earth=Georeference((48.0, 11.0, 500.0), NORTH, np.eye(6) * 0.01))
    told = value("earth", world)
    assert (told["origin"], told["yaw"], told["sigma_yaw"]) == (
        [48.0, 11.0, 500.0],
        pytest.approx(np.pi / 2),
        0.1,
    )
    assert told["map_T_earth"] == NORTH.tolist()
    assert len(told["covariance"]) == 36
    assert "why" not in told
    robot, landmark = value("place@now", world), value("place/tag36h11:5", world)
    for place, north, west, up in ((robot, 3 - 10, 0, -5), (landmark, 1 - 10, 2, 3 - 5)):
        meters = (place - (48.0, 11.0, 500.0)) * (111_194.0, 74_402.0, 1.0)  # a degree, at 48 north
        np.testing.assert_allclose(meters, [north, -west, up], atol=0.05)


def test_a_map_that_has_no_place_on_the_earth_yet_says_why() -> None:
    world = World(
        earth=Georeference((48.0, 11.0, 500.0), why="yaw not yet observable: the fixes reach over 0.2 m")
    )
    told = value("earth", world)
    assert (told["origin"], told["map_T_earth"], told["covariance"]) == ([48.0, 11.0, 500.0], None, None)
    assert told["why"].startswith("yaw not yet observable")
    for name in ("place@now", "place/tag36h11:5"):
        assert one(name, world).why.endswith("yaw not yet observable: the fixes reach over 0.2 m")
    for name in ("earth", "place@now"):
        assert "no source of kind gnss" in one(name).why
    assert "no landmark" in one("place/9", world).why
