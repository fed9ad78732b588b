"""Without a configuration: what a bag's topics are is told from their types and first messages."""

import numpy as np
import pytest

from slam_backend.core.errors import BadConfig
from slam_backend.core.measurement import SECOND
from slam_backend.io.bags import write_bag
from slam_backend.io.discover import discover
from slam_backend.io.encode import (
    encode_cloud,
    encode_fix,
    encode_imu,
    encode_odometry,
    encode_pose_with_covariance,
    encode_transforms,
)
from slam_backend.io.inputs import open_inputs
from slam_backend.io.records import Record

ODOMETRY, CLOUD = "nav_msgs/msg/Odometry", "sensor_msgs/msg/PointCloud2"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ZERO = np.zeros(36), np.zeros(6), np.zeros(36)


def odometry(n, topic="/odom", frames=("odom", "base"), z=0.0):
    data = encode_odometry((n + 1) * SECOND, *frames, np.array([n, 0, z, 0, 0, 0, 1.0]), *ZERO)
    return Record(topic, ODOMETRY, n, data)


def pose(n, topic, frame):
    data = encode_pose_with_covariance((n + 1) * SECOND, frame, np.array([n, 0, 0, 0, 0, 0, 1.0]), ZERO[0])
    return Record(topic, COVARIANCE, n, data)


def fix(n):
    data = encode_fix((n + 1) * SECOND, "gps", (48.0, 9.0 + n * 1e-5, 400.0), np.eye(3))
    return Record("/fix", "sensor_msgs/msg/NavSatFix", n, data)


def imu(n):
    data = encode_imu((n + 1) * SECOND, "imu", (0, 0, 0), (0, 0, 9.81), np.zeros(9), np.zeros(9))
    return Record("/imu", "sensor_msgs/msg/Imu", n, data)


def cloud(n, topic, *names):
    return Record(
        topic, CLOUD, n, encode_cloud((n + 1) * SECOND, "base", {name: np.ones(2) for name in names})
    )


def transforms(n, parent, child, topic="/tf"):
    return Record(
        topic,
        TRANSFORMS,
        n,
        encode_transforms((n + 1) * SECOND, parent, {child: np.array([n, 0, 0, 0, 0, 0, 1.0])}),
    )


@pytest.fixture
def found(tmp_path):
    def look(*records):
        path = tmp_path / "bag.mcap"
        path.unlink(missing_ok=True)
        write_bag(path, sorted(records, key=lambda r: r.log_time), strictly_increasing=True)
        with open_inputs([path]) as inputs:
            return discover(inputs)

    return look


def test_each_kind_is_told_from_type_frame_and_fields(found):
    config, notes = found(
        *(odometry(n) for n in range(5)),
        odometry(2, "/closures", ("base@1.000000000", "base@2.000000000")),
        cloud(1, "/trees", "id", "x", "y"),
        cloud(1, "/bearings", "id", "azimuth"),
        cloud(1, "/scan", "x", "y", "z"),
        cloud(1, "/batch", "stamp_i_sec", "stamp_i_nsec"),
        pose(1, "/initialpose", "map"),
    )
    assert {name: (s.kind, s.topic) for name, s in config.sources.items()} == {
        "odom": ("odometry", "/odom"), "closures": ("relative", "/closures"), "trees": ("landmark", "/trees"),
        "bearings": ("landmark", "/bearings"), "batch": ("relative", "/batch"), "initialpose": ("pose", "/initialpose"),
    }  # fmt: skip
    assert not any("/scan" in note for note in notes)


def test_of_several_odometries_the_richest_drives_and_the_others_are_named(found):
    config, notes = found(
        *(odometry(n) for n in range(3)), *(odometry(n, "/visual/odometry") for n in range(9)),
        *(pose(n, "/wheels", "odom") for n in range(20)),
    )  # fmt: skip
    assert {s.topic for s in config.sources.values()} == {"/visual/odometry"}
    assert list(config.sources) == ["visual_odometry"]
    assert sum("left aside: /visual/odometry is the odometry" in note for note in notes) == 2


def test_ground_truth_is_not_taken_for_a_sensor(found):
    config, notes = found(odometry(0), odometry(0, "/ground_truth"), pose(0, "/vicon/base", "map"))
    assert list(config.sources) == ["odom"]
    assert sum("ground truth" in note for note in notes) == 2


@pytest.mark.parametrize(("z", "space"), [(0.0, "2d"), (1e-3, "3d")])
def test_the_plane_is_told_from_exact_zeros(found, z, space):
    config, notes = found(*(odometry(n, z=z * (n == 3)) for n in range(5)))
    assert config.space == space
    assert any(f"space {space}" in note for note in notes)


def test_a_bag_that_nothing_can_drive_is_said_with_its_topics(found):
    with pytest.raises(
        BadConfig, match=r"no odometry, relative poses or fixes .* it has /trees \(sensor_msgs"
    ):
        found(cloud(0, "/trees", "id", "x", "y"))


def test_relative_poses_alone_drive(found):
    config, _ = found(odometry(2, "/steps", ("base@1.000000000", "base@2.000000000")))
    assert config.driver == "steps"


def test_fixes_drive_where_there_is_no_odometry_and_an_imu_is_left_aside_with_the_reason(found):
    """How an IMU is mounted, and how good it is, cannot be told from its messages."""
    config, notes = found(
        *(each(n) for n in range(5) for each in (fix, imu)), cloud(1, "/trees", "id", "x", "y")
    )
    assert (config.driver, config.space, list(config.sources)) == ("fix", "3d", ["fix", "trees"])
    assert any("/imu is left aside" in note and "kind: imu" in note for note in notes)
    assert any("constant velocity" in note for note in notes)
    config, _ = found(odometry(0), fix(1), imu(2))
    assert (config.driver, set(config.sources)) == ("odom", {"odom", "fix"})


def test_an_imu_or_absolute_poses_alone_drive_only_where_that_is_asked(found):
    for records in ([imu(0)], [pose(0, "/initialpose", "map")]):
        with pytest.raises(BadConfig, match="where a configuration names them under 'sources'"):
            found(*records)


def test_without_an_odometry_topic_the_pair_odom_to_base_on_tf_serves(found):
    """Though /tf begins with other pairs, and poses of who knows what are there too; not what is static."""
    config, notes = found(
        *(transforms(n, "base", "wheel") for n in range(10)), *(transforms(n, "odom", "base") for n in range(10, 20)),
        *(transforms(n, "odom", "anchor", "/tf_static") for n in range(30)), *(pose(n, "/goal", "odom") for n in range(40)),
    )  # fmt: skip
    assert {name: (s.kind, s.topic) for name, s in config.sources.items()} == {"tf": ("odometry", "/tf")}
    assert config.space == "2d"
    config, notes = found(*(transforms(n, "odom", "base") for n in range(9)), odometry(3))
    assert list(config.sources) == ["odom"]
    assert any("/tf is left aside: /odom is the odometry" in note for note in notes)


def test_transforms_of_other_pairs_are_no_odometry(found):
    with pytest.raises(BadConfig, match="no odometry, relative poses or fixes"):
        found(*(transforms(n, "map", "odom") for n in range(9)))
