"""Going on in a map: the old trajectory stays, the new one is apart until a measurement joins it."""

import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import Config, config_from
from slam_backend.core.errors import SlamError
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.landmark import LandmarkObservation
from slam_backend.core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from slam_backend.core.sensors.pose import AbsolutePose
from slam_backend.core.sensors.relative import RelativePose
from slam_backend.core.trajectory import Trajectory

CONFIG = config_from(
    {
        "space": "2d", "keyframes": {"every": True}, "sources": ["odometry", "relative", "landmark", "pose"],
        **{kind: {"kind": kind} for kind in ("odometry", "relative", "landmark", "pose")},
    }
)  # fmt: skip
LATER = 1000  # s between the sessions
NOTHING = Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 7)))
TREES = {"oak": (2.0, 3.0), "elm": (5.0, -2.0), "ash": (8.0, 3.0), "fir": (4.0, 4.0)}


def seven(x, y, yaw):
    return frozen([x, y, 0, 0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])


def odometry(second, x, y=0.0, yaw=0.0):
    return OdometryPose(
        second * SECOND, "odometry", "odom", "base", seven(x, y, yaw), UNKNOWN, STILL, UNKNOWN
    )


def sees(second, name, x, y):
    """From a robot that stands at x, y and looks along the x axis of the map."""
    tree = frozen([TREES[name][0] - x, TREES[name][1] - y, 0])
    return LandmarkObservation(
        second * SECOND, "landmark", "", name, "position", tree, frozen(np.eye(3) * 1e-4)
    )


def sees_tag(second, x, y):
    """The same of a tag at 5, 1 that looks back along the way."""
    place, noise = seven(5 - x, 1 - y, 2.5), frozen(np.eye(6) * 1e-4)
    return LandmarkObservation(second * SECOND, "landmark", "", "tag36h11:5", "pose", place, noise)


def loop(second, i, j, x, y=0.0, yaw=0.0):
    covariance = frozen(np.eye(6).ravel() * 1e-4)
    return RelativePose(
        second * SECOND, "relative", i * SECOND, j * SECOND, "", "", seven(x, y, yaw), covariance
    )


def pose(second, x, y, yaw):
    return AbsolutePose(second * SECOND, "pose", "", seven(x, y, yaw), frozen(np.eye(6).ravel() * 1e-4))


def first_drive(config=CONFIG, tag=False):
    """Ten metres along the x axis of the map, past the trees."""
    backend = Backend(config)
    for n in range(11):
        for name in TREES if n in (3, 7) else ():
            backend.add(sees(n + 1, name, n, 0))
        if tag and n == 3:
            backend.add(sees_tag(n + 1, n, 0))
        backend.add(odometry(n + 1, n))
    backend.finish()
    backend.polish()
    return backend


def second_drive(*more, seconds=5, tag=False):
    """Begins 4 m along the old way; its odometry says that it starts at its own origin, turned by a right angle."""
    backend = Backend(CONFIG)
    backend.load(first_drive(tag=tag).saved(NOTHING))
    told = sorted(more, key=lambda m: m.stamp)
    for n in range(seconds):
        stamp = (LATER + n) * SECOND
        for measurement in [m for m in told if m.stamp <= stamp]:
            backend.add(measurement)
            told.remove(measurement)
        backend.add(odometry(LATER + n, 0, n, np.pi / 2))
    return backend


def positions(backend):
    return backend.snapshot().trajectory.sevens[:, :2]


def test_a_loaded_map_is_where_it_was_to_the_last_digits_of_the_solver():
    before = first_drive()
    after = Backend(CONFIG)
    after.load(before.saved(NOTHING))
    old, new = before.snapshot(), after.snapshot()
    np.testing.assert_allclose(new.trajectory.sevens, old.trajectory.sevens, atol=1e-9)
    np.testing.assert_allclose(new.landmarks, old.landmarks, atol=1e-9)
    assert new.names == old.names
    assert new.odometry.sevens.shape == old.odometry.sevens.shape
    assert list(after.solver.factors) == list(before.solver.factors)


def test_the_new_trajectory_is_a_part_of_its_own_until_something_joins_it():
    backend = second_drive()
    assert len(backend.parts) == 2
    np.testing.assert_allclose(positions(backend)[:11], [[n, 0] for n in range(11)], atol=1e-6)
    np.testing.assert_allclose(positions(backend)[11:], [[n, 0] for n in range(5)], atol=1e-6)
    assert backend.snapshot().indices.tolist() == list(range(16)), "no index comes twice"


@pytest.mark.parametrize(
    "joint",
    [
        [loop(LATER + 2, 6, LATER + 1, 0.0)],
        [pose(LATER + 2, 6, 0, 0)],
        [sees(LATER + 2, name, 6, 0) for name in ("oak", "elm", "ash")],
    ],
    ids=["relative", "absolute", "landmarks"],
)
def test_the_first_measurement_between_them_joins_it_and_the_old_trajectory_stays(joint):
    backend = second_drive(*joint)
    assert len(backend.parts) == 1
    np.testing.assert_allclose(positions(backend)[:11], [[n, 0] for n in range(11)], atol=1e-3)
    np.testing.assert_allclose(positions(backend)[11:], [[4 + n, 0] for n in range(5)], atol=1e-2)
    assert sum(factor.kind == "gauge" for factor in backend.solver.factors.values()) == 1


def test_one_tag_that_both_have_seen_joins_them():
    """What waited is used once, and the tag keeps its place and its heading."""
    backend = second_drive(sees_tag(LATER + 2, 6, 0), sees_tag(LATER + 2, 6, 0), tag=True)
    assert len(backend.parts) == 1
    np.testing.assert_allclose(positions(backend)[:11], [[n, 0] for n in range(11)], atol=1e-3)
    np.testing.assert_allclose(positions(backend)[11:], [[4 + n, 0] for n in range(5)], atol=1e-2)
    assert sum(factor.kind == "gauge" for factor in backend.solver.factors.values()) == 1
    snapshot, key = backend.snapshot(), backend.landmark("tag36h11:5")
    assert sum(key in factor.keys for factor in backend.solver.factors.values()) == 3
    np.testing.assert_allclose(snapshot.landmarks[snapshot.names.index("tag36h11:5")], [5, 1, 0], atol=1e-2)
    np.testing.assert_allclose(snapshot.orientations["tag36h11:5"], seven(0, 0, 2.5)[3:], atol=1e-2)
    assert list(snapshot.orientations) == ["tag36h11:5"]


def test_after_the_joint_old_landmarks_are_seen_by_their_names():
    backend = second_drive(
        loop(LATER + 2, 6, LATER + 1, 0.0), sees(LATER + 1, "fir", 5, 0), sees(LATER + 3, "fir", 7, 0)
    )
    name = backend.landmark("fir")
    seen = [f.stamp // SECOND for f in backend.solver.factors.values() if name in f.keys]
    assert seen == [4, 8, LATER + 1, LATER + 3], "what was seen before the joint is used after it"
    assert len(backend.snapshot().names) == len(TREES)


def test_too_few_landmarks_or_such_that_contradict_do_not_join():
    """Two could be any two; and of three of which one is another tree, no two agree with the third."""
    assert len(second_drive(sees(LATER, "oak", 4, 0), sees(LATER, "elm", 4, 0)).parts) == 2
    wrong = sees(LATER, "ash", -14, 9)
    assert len(second_drive(sees(LATER, "oak", 4, 0), sees(LATER, "elm", 4, 0), wrong).parts) == 2
    enough = second_drive(sees(LATER, "oak", 4, 0), sees(LATER, "elm", 4, 0), wrong, sees(LATER, "fir", 4, 0))
    assert len(enough.parts) == 1
    far = [i for i, f in enough.solver.factors.items() if f.stamp == LATER * SECOND and f.kind == "landmark"]
    assert len(far) == 4, (
        "once joined, the stray one is a sighting like any other: kernels and stages judge it"
    )


def test_an_absolute_pose_later_does_not_move_the_map():
    backend = second_drive(loop(LATER + 2, 6, LATER + 1, 0.0), pose(LATER + 4, 9, 0, 0))
    np.testing.assert_allclose(positions(backend)[0], [0, 0], atol=1e-2)
    assert sum(factor.kind == "gauge" for factor in backend.solver.factors.values()) == 1


def test_nothing_is_known_between_two_sessions():
    backend = second_drive(pose(LATER + 2, 6, 0, 0), sees(500, "oak", 0, 0))
    snapshot = backend.snapshot()
    assert snapshot.trajectory.breaks.tolist() == [LATER * SECOND] == snapshot.odometry.breaks.tolist()
    wanted = [
        int(10.5 * SECOND),
        11 * SECOND,
        500 * SECOND,
        (LATER - 1) * SECOND,
        LATER * SECOND,
        int((LATER + 0.5) * SECOND),
    ]
    known = [True, True, False, False, True, True]
    assert np.isfinite(snapshot.at(wanted)).all(axis=1).tolist() == known
    assert np.isfinite(snapshot.trajectory.at(wanted)).all(axis=1).tolist() == known
    assert not any(factor.stamp == 500 * SECOND for factor in backend.solver.factors.values())


def test_ids_go_on_where_the_map_ends():
    """A loop that is found again about the same moments gets an id of its own."""
    backend = Backend(CONFIG)
    before = first_drive()
    for _ in range(2):
        before.add(loop(9, 2, 8, 6.0))
    before.finish()
    backend.load(before.saved(NOTHING))
    backend.add(loop(9, 2, 8, 6.0))
    backend.add(odometry(LATER, 0))
    loops = [id_ for id_ in backend.solver.factors if id_.startswith("relative/")]
    assert loops == [f"relative/9.000000000/{n}" for n in range(3)]


def test_a_third_session_goes_on_in_the_second():
    second = second_drive(loop(LATER + 2, 6, LATER + 1, 0.0))
    third = Backend(CONFIG)
    third.load(second.saved(NOTHING))
    for n in range(3):
        if n == 1:
            third.add(loop(2 * LATER + 1, LATER + 3, 2 * LATER, 0.0))
        third.add(odometry(2 * LATER + n, n))
    assert len(third.parts) == 1
    assert third.snapshot().trajectory.breaks.tolist() == [LATER * SECOND, 2 * LATER * SECOND]
    np.testing.assert_allclose(positions(third)[16:], [[7 + n, 0] for n in range(3)], atol=1e-2)
    assert third.dead_reckoning().size() == len(third.timeline) + len(TREES)


def test_edges_without_odometry_go_on_too():
    """An edge to a keyframe of the map joins; one that asks for a moment of the map that is none is refused."""
    config = Config(space="2d")
    config = config.model_copy(update={"sources": {"relative": CONFIG.sources["relative"]}})
    first, second = Backend(config), Backend(config)
    for n in range(1, 5):
        first.add(loop(n + 1, n, n + 1, 1.0))
    first.finish()
    second.load(first.saved(NOTHING))
    for measurement in (
        loop(LATER, 3, LATER, 0.0, 1.0), loop(LATER + 1, LATER, LATER + 1, 1.0), loop(LATER + 2, LATER + 1, LATER + 2, 1.0),
        loop(LATER + 3, LATER + 2, LATER + 3, 1.0),
    ):  # fmt: skip
        second.add(measurement)
    second.finish()
    assert len(second.parts) == 1
    np.testing.assert_allclose(positions(second)[5:], [[2 + n, 1] for n in range(4)], atol=1e-3)


def test_a_map_is_loaded_before_all_else_and_in_its_own_space():
    saved = first_drive().saved(NOTHING)
    begun = Backend(CONFIG)
    begun.add(odometry(1, 0))
    with pytest.raises(SlamError, match="only before the first keyframe"):
        begun.load(saved)
    with pytest.raises(SlamError, match="made in space 2d, and this is space 3d"):
        Backend(CONFIG.model_copy(update={"space": "3d"})).load(saved)
