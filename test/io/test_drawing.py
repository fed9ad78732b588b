"""A snapshot as clouds and markers, read back by rosbags."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from slam_backend.core.graph import Decision
from slam_backend.core.measurement import SECOND
from slam_backend.core.sensors.cloud import columns
from slam_backend.core.trajectory import Snapshot, Trajectory
from slam_backend.io.drawing import drawn_graph, landmark_cloud, trajectory_cloud

STORE = get_typestore(Stores.ROS2_JAZZY)


def snapshot_of(count, names=()):
    """Keyframes one second apart, at x = 0, 1, 2 ... m."""
    sevens = np.zeros((count, 7))
    sevens[:, 0], sevens[:, 6] = np.arange(count), 1
    way = Trajectory(np.arange(count) * SECOND, sevens)
    return Snapshot(way, np.arange(count), way, names, np.arange(3.0 * len(names)).reshape(-1, 3), 0)


def landmarks(*names):
    data = landmark_cloud(0, "map", snapshot_of(1, names), None)
    return columns(STORE.deserialize_cdr(data, "sensor_msgs/msg/PointCloud2"))


def test_landmarks_with_numbers_for_names_have_them_as_ids() -> None:
    """As our own decoder of clouds reads them."""
    table = landmarks("7", "0", "4294967295")
    assert list(table) == ["id", "x", "y", "z"]
    assert table["id"].dtype == np.uint32
    assert table["id"].tolist() == [7, 0, 4294967295]
    assert table["y"].tolist() == [1, 4, 7]


@pytest.mark.parametrize("odd", ["tag36h11:5", "007", "4294967296", "-1", "2.5", "größe", "²", ""])
def test_one_name_that_is_no_number_sends_all_names_along(odd) -> None:
    """Then the ids count, and the text is beside each."""
    table = landmarks("7", odd, "eleven")
    assert table["id"].tolist() == [0, 1, 2]
    assert [bytes(row).rstrip(b"\0").decode() for row in table["name"]] == ["7", odd, "eleven"]


def test_a_number_that_is_at_two_places_is_the_id_of_both() -> None:
    """And the names tell which is which; the ids of all others stay."""
    table = landmarks("7", "5", "5~2")
    assert table["id"].tolist() == [7, 5, 5]
    assert [bytes(row).rstrip(b"\0").decode() for row in table["name"]] == ["7", "5", "5~2"]


def test_without_landmarks_and_keyframes_there_are_empty_clouds() -> None:
    """And a graph that deletes what was drawn."""
    empty = snapshot_of(0)
    for data in (landmark_cloud(0, "map", empty, None), trajectory_cloud(0, "map", empty, None)):
        assert STORE.deserialize_cdr(data, "sensor_msgs/msg/PointCloud2").width == 0
    assert [len(marker.points) for marker in drawn_graph(empty, (), 0.05)] == [0] * 5


def test_covariances_of_another_number_are_refused() -> None:
    """A covariance for each keyframe, or none."""
    with pytest.raises(ValueError, match="reshape"):
        trajectory_cloud(0, "map", snapshot_of(3), np.zeros((2, 36)))


def loop(id_, verdict, a, b):
    return Decision(0, id_, "loops", verdict, "admit", "rule", ends=(a, b))


def lines(count, *decisions):
    drawn = drawn_graph(snapshot_of(count), decisions, 0.05)
    return {marker.name: marker.points[:, 0].tolist() for marker in drawn if marker.shape == "lines"}


def test_the_last_verdict_of_a_loop_is_drawn() -> None:
    """One that waited and then was accepted is an accepted one."""
    first, last = loop("l/1/0", "probation", 0, SECOND), loop("l/1/0", "accepted", 0, SECOND)
    assert lines(3, first, last) == {"loops": [0, 1], "probation": [], "refused": []}


def test_loops_end_between_keyframes_or_are_not_drawn() -> None:
    """At their own stamps, where the robot was; an end beyond the trajectory has no place."""
    inside, outside = (
        loop("l/1/0", "refused", SECOND // 2, 2 * SECOND),
        loop("l/2/0", "refused", 0, 9 * SECOND),
    )
    assert lines(3, inside, outside) == {"loops": [], "probation": [], "refused": [0.5, 2]}
