"""Between topic and journal: jumps of a clock, sources that are found while their messages come."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from slam_backend.core.config import Config, config_from
from slam_backend.core.measurement import SECOND
from slam_backend.io import events
from slam_backend.io.encode import (
    encode_cloud,
    encode_fix,
    encode_imu,
    encode_odometry,
    encode_pose_with_covariance,
    encode_transforms,
)
from slam_backend.io.journal import Journal, JournalReader
from slam_backend.io.records import Record
from slam_backend.io.typestore import typestore_of
from slam_backend.ros import finder as module
from slam_backend.ros import intake as intake_module
from slam_backend.ros.finder import Finder
from slam_backend.ros.intake import Intake, Jumps

START = 1_700_000_000 * SECOND
ZEROS = np.zeros(36), np.zeros(6), np.zeros(36)
POSE = (0, 0, 0, 0, 0, 0, 1)
ODOMETRY = Record("/odom", "nav_msgs/msg/Odometry", 0, encode_odometry(START, "odom", "base", POSE, *ZEROS))
LOOP = replace(
    ODOMETRY,
    topic="/loops",
    data=encode_odometry(START, "base@5.000000000", "base@6.000000000", POSE, *ZEROS),
)
IN_MAP = Record(
    "/localizer",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    0,
    encode_pose_with_covariance(START, "map", POSE, ZEROS[0]),
)
TAGS = Record(
    "/tags", "sensor_msgs/msg/PointCloud2", 0,
    encode_cloud(START, "camera", {name: np.ones(2) for name in ("id", "x", "y", "z")}),
)  # fmt: skip
FIX = Record("/fix", "sensor_msgs/msg/NavSatFix", 0, encode_fix(START, "gps", (48.0, 9.0, 400.0), np.eye(3)))
IMU = Record(
    "/imu", "sensor_msgs/msg/Imu", 0,
    encode_imu(START, "imu", (0, 0, 0), (0, 0, 9.81), np.zeros(9), np.zeros(9)),
)  # fmt: skip
SCAN = replace(TAGS, topic="/scan", data=encode_cloud(START, "lidar", {name: np.ones(2) for name in "xyz"}))


def transforms(parent, child):
    return Record("/tf", "tf2_msgs/msg/TFMessage", 0, encode_transforms(START, parent, {child: POSE}))


def jumps(*seconds):
    seen = Jumps()
    return [seen.jumped_back(round((1000 + s) * SECOND)) for s in seconds]


@pytest.mark.parametrize(
    "seconds",
    [
        (0, 1, 2, 3),
        (0, 100, 101),  # a pause, or a jump ahead
        (10, 9.5, 9.6, 9.7),  # late by less than a second
        (10, 3, 10.1, 10.2),  # one odd stamp
        (10, 3, 10.1, 3, 10.2, 3),  # again and again
        (10, 3, 3, 3, 10.1),  # that does not move
        (10, 5, 3, 10.1),  # nor goes on
    ],
)
def test_what_is_no_jump_back(seconds) -> None:
    assert not any(jumps(*seconds))


def test_a_jump_is_told_once_by_the_second_message_after_it() -> None:
    assert jumps(10, 11, 3, 3.1, 3.2, 4, 5) == [False, False, False, True, False, False, False]
    assert jumps(10, 3, 3.1, 3.2, 1, 1.1) == [False, False, True, False, False, True]


class Seen:
    """A finder, and what it has made of all that it has seen."""

    def __init__(self):
        self.finder, self.config = Finder(typestore_of(())), Config()

    def look(self, *records):
        for record in records:
            self.config = self.finder.look(record, self.config)
        return {source.topic: source.kind for source in self.config.sources.values()}

    def wants(self, record):
        return self.finder.wants(record, self.config)


@pytest.fixture
def seen():
    return Seen()


@pytest.fixture
def impatient(monkeypatch):
    """No topic waits for a better one."""
    monkeypatch.setattr(module, "PATIENCE", {})
    monkeypatch.setattr(module, "LONGEST", 0.0)


def test_odometry_drives_at_once_and_brings_in_what_waited(seen) -> None:
    assert seen.look(LOOP, TAGS, IN_MAP) == {}
    assert all(seen.wants(record) for record in (LOOP, TAGS, IN_MAP))
    assert seen.look(ODOMETRY) == {"/odom": "odometry", "/tags": "landmark", "/localizer": "pose"}
    assert seen.look(LOOP)["/loops"] == "relative"
    assert seen.config.driver == "odom"


def test_sources_that_were_found_before_a_crash_are_wanted_at_once(seen) -> None:
    """Though nothing has been heard of them since."""
    seen.look(ODOMETRY, LOOP)
    seen.finder = Finder(typestore_of(()))
    assert seen.wants(LOOP)
    assert seen.look(LOOP) == {"/odom": "odometry", "/loops": "relative"}


def test_what_is_of_no_use_is_told_with_the_reason(seen) -> None:
    truth, second = replace(ODOMETRY, topic="/ground_truth"), replace(ODOMETRY, topic="/odom2")
    rubbish = replace(ODOMETRY, topic="/rubbish", data=b"\0\1\0\0")
    assert seen.look(ODOMETRY, truth, second, SCAN, rubbish) == {"/odom": "odometry"}
    assert seen.finder.unused == {
        "/ground_truth": "it is taken for ground truth",
        "/odom2": "'odom' is the odometry",
        "/scan": "it holds nothing that could be used",
        "/rubbish": "it holds nothing that could be used",
    }
    assert not any(seen.wants(record) for record in (truth, second, SCAN, rubbish))


def test_the_pair_on_tf_waits_for_better_odometry(seen) -> None:
    pair = transforms("odom", "base")
    assert seen.look(transforms("base", "wheel"), pair) == {}
    assert seen.wants(pair)
    assert not seen.wants(transforms("base", "wheel"))
    assert seen.look(ODOMETRY, pair) == {"/odom": "odometry"}
    assert not seen.wants(pair)


def test_after_a_while_the_pair_on_tf_serves(seen, impatient) -> None:
    assert seen.look(transforms("base", "wheel"), transforms("odom", "base")) == {"/tf": "odometry"}


def test_relative_poses_drive_when_nothing_else_does_and_give_way(seen, impatient) -> None:
    assert seen.look(LOOP) == {"/loops": "relative"}
    assert seen.config.driver == "loops"
    assert seen.look(ODOMETRY) == {"/loops": "relative", "/odom": "odometry"}
    assert seen.config.driver == "odom"


def test_fixes_drive_when_nothing_else_does_and_give_way(seen, impatient) -> None:
    assert seen.look(FIX, TAGS) == {"/fix": "gnss", "/tags": "landmark"}
    assert seen.config.driver == "fix"
    assert seen.look(ODOMETRY) == {"/fix": "gnss", "/tags": "landmark", "/odom": "odometry"}
    assert seen.config.driver == "odom"


def test_fixes_wait_a_while_for_odometry(seen) -> None:
    assert seen.look(FIX, FIX) == {}
    assert seen.look(ODOMETRY) == {"/odom": "odometry", "/fix": "gnss"}


def test_an_imu_is_never_taken_for_odometry(seen, impatient) -> None:
    assert seen.look(IMU, IMU) == {}
    assert "where a configuration names it" in seen.finder.unused["/imu"]
    assert not seen.wants(IMU)


def test_a_topic_that_is_called_like_a_setting_is_a_source_all_the_same(seen) -> None:
    seen.look(replace(ODOMETRY, topic="/path"), replace(LOOP, topic="/sources"))
    assert {name: source.topic for name, source in seen.config.sources.items()} == {
        "path_": "/path",
        "sources_": "/sources",
    }


@dataclass
class Node:
    """Where an intake stands in for nobody: its session comes later."""

    config: Config
    session: object = None
    moves: list[int] = field(default_factory=list)
    anew: list[str] = field(default_factory=list)

    def begins_anew(self, source) -> bool:
        self.anew.append(source)
        self.session = None
        return True

    def moved(self, odometry) -> None:
        self.moves.append(odometry.stamp)


def odometry(seconds):
    return encode_odometry(START + round(seconds * SECOND), "odom", "base", POSE, *ZEROS)


def wheels_and_tags():
    """A node that has these sources, and its intake."""
    config = config_from(
        {
            "sources": ["wheels", "tags"],
            "wheels": {"kind": "odometry", "topic": "/odom"},
            "tags": {"kind": "landmark", "topic": "/tags"},
        }
    )
    node = Node(config)
    intake = Intake(node, typestore_of(()), finding=False)
    intake.use(config)
    return node, intake


def test_what_comes_just_before_the_odometry_tells_of_a_jump_is_for_the_new_session(tmp_path) -> None:
    """Topics overtake each other: of a bag that is played again, the tags may come before the odometry."""
    node, intake = wheels_and_tags()
    before, after = (Journal(tmp_path / name, print) for name in ("before", "after"))
    node.session = SimpleNamespace(journal=before)
    for data in (odometry(10), odometry(11)):
        intake.receive("/odom", ODOMETRY.type, data)
    intake.receive("/tags", TAGS.type, TAGS.data)
    for data in (odometry(0), odometry(0.1)):
        intake.receive("/odom", ODOMETRY.type, data)
    assert node.anew == ["wheels"]
    node.session = SimpleNamespace(journal=after)
    intake.drain()
    for journal in (before, after):
        journal.close()
    reader = JournalReader(after.path)
    found = [row.record for row in reader.after(0, 10)]
    reader.close()
    assert [record.topic for record in found] == ["/tags", "/odom", "/odom"]
    assert [record.data for record in found][1:] == [odometry(0), odometry(0.1)]


def test_a_flood_between_two_sessions_costs_its_own_oldest_and_is_confessed(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(intake_module, "LIMIT", 100)
    node, intake = wheels_and_tags()
    for n in range(40):
        intake.receive("/odom", ODOMETRY.type, odometry(n / 10))
        for _ in range(10):
            intake.receive("/tags", TAGS.type, TAGS.data)
    incidents = []
    journal = Journal(tmp_path, incidents.append)
    node.session = SimpleNamespace(journal=journal)
    intake.drain()
    journal.close()
    reader = JournalReader(journal.path)
    found = [row.record for row in reader.after(0, 1000)]
    reader.close()
    assert [record.topic for record in found].count("/odom") == len(node.moves) == 40
    assert [record.topic for record in found].count("/tags") == 60
    gap = events.event_of(found[0].data)
    assert (gap["event"], gap["lost"]) == ("gap", 340)
    assert journal.lost == 340
    assert "340 of /tags" in incidents[0]
