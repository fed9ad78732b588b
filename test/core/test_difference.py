"""How far things moved between two beliefs, against shifts that are known."""

import numpy as np

from slam_backend.core.backend import Update
from slam_backend.core.difference import Jumps, difference
from slam_backend.core.graph import Decision, keyframe
from slam_backend.core.trajectory import Snapshot, Trajectory


def seven(x, y, yaw):
    return [x, y, 0.0, 0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]


def snapshot(stamps, poses, landmarks, revision):
    track = Trajectory(np.array(stamps, dtype=np.int64), np.array([seven(*pose) for pose in poses]))
    names = tuple(landmarks)
    points = np.array([[*landmarks[name], 0.0] for name in names]).reshape(-1, 3)
    return Snapshot(track, np.arange(len(stamps)), track, names, points, revision)


def test_shifts_are_those_of_what_both_beliefs_have():
    before = snapshot([10, 20], [(0, 0, 0), (1, 0, 0)], {"a": (1, 1), "lost": (0, 0)}, 3)
    after = snapshot([10, 15, 20], [(0, 0, 0), (9, 9, 0), (1, 0.3, 3.0)], {"a": (1, 1.5), "new": (2, 2)}, 5)
    found = difference(before, after, {}, {}, Jumps())
    assert found.stamps.tolist() == [10, 20]
    np.testing.assert_allclose(found.meters, [0, 0.3])
    np.testing.assert_allclose(found.radians, [0, 3.0])
    assert found.names == ("a",)
    np.testing.assert_allclose(found.landmarks, [0.5])
    assert (found.keyframes, found.revisions, found.moved) == ((2, 3), (3, 5), 1)


def test_a_jump_is_that_of_the_newest_pose_from_where_the_old_correction_would_have_it():
    """Odometry has driven to (10, 0); the correction turns by 0.1 rad about the origin."""
    jumps = Jumps()
    jumps.add(Update(keyframe(0, 10), tuple(seven(0, 0, 0)), tuple(seven(0, 0, 0)), 0, ()))
    told = Decision(20, "loops/0.000000020/0", "loops", "accepted", "admit", "unjudged")
    pose = seven(10 * np.cos(0.1), 10 * np.sin(0.1), 0.1)
    jumps.add(Update(keyframe(1, 20), tuple(pose), tuple(seven(0, 0, 0.1)), 1, (told,)))
    jump = jumps.of[told.id]
    np.testing.assert_allclose(jump, (2 * 10 * np.sin(0.05), 0.1))
