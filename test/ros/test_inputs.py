"""What is listened to: QoS that fits whoever publishes, sources that nobody configured, silence that is said."""

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

pytest.importorskip("rclpy")

from slam_backend.core.config import Config, config_from
from slam_backend.core.measurement import SECOND
from slam_backend.io.encode import (
    encode_cloud,
    encode_odometry,
    encode_pose_with_covariance,
    encode_transforms,
)
from slam_backend.io.records import Record
from slam_backend.ros.inputs import Inputs

ODOMETRY, CLOUD = "nav_msgs/msg/Odometry", "sensor_msgs/msg/PointCloud2"
POSE, TRANSFORMS = "geometry_msgs/msg/PoseWithCovarianceStamped", "tf2_msgs/msg/TFMessage"
START = 1_700_000_000 * SECOND
needs_tf2 = pytest.mark.skipif(find_spec("tf2_msgs") is None, reason="tf2_msgs is not there: `make tf`")


def odometry(n, frames=("odom", "base"), x=None):
    zeros = np.zeros(36)
    pose = (n * 0.1 if x is None else x, 0, 0, 0, 0, 0, 1)
    return encode_odometry(START + n * SECOND // 10, *frames, pose, zeros, np.zeros(6), zeros)


class Ear:
    """Inputs of a node of this process, and what they take."""

    def __init__(self, peer, config, *, finding=False):
        self.heard, self.peer, self.config = [], peer, config
        self.inputs = Inputs(peer.node, lambda *message: self.heard.append(message), finding=finding)

    def look_until(self, condition, seconds=10.0):
        def looked():
            self.inputs.look(self.config)
            self.peer.spin(0.1)
            return condition()

        self.peer.until(looked, seconds)

    def bytes_on(self, topic):
        return [data for name, _, data in self.heard if name == topic]

    @property
    def flow(self):
        return self.inputs.flows["/odom"]


@pytest.fixture
def ear(peer):
    made = Ear(peer, config_from({"sources": ["wheels"], "wheels": {"kind": "odometry", "topic": "/odom"}}))
    yield made
    made.inputs.close()


def said(ear, *publishers):
    """Let each say something of its own until all of it has been heard."""
    number = len(ear.heard) + 1000
    words = [odometry(number + k) for k in range(len(publishers))]
    for publisher, word in zip(publishers, words, strict=True):
        publisher.publish(word)
    ear.peer.until(lambda: all(word in ear.bytes_on("/odom") for word in words), 5)


@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("latched", [True, False])
def test_one_publisher_of_any_kind_is_heard(ear, peer, reliable, latched) -> None:
    """What a latched one has said before is heard as well."""
    publisher = peer.publisher("/odom", ODOMETRY, reliable=reliable, latched=latched)
    publisher.publish(odometry(1))
    ear.look_until(publisher.get_subscription_count)
    said(ear, publisher)
    assert (odometry(1) in ear.bytes_on("/odom")) == (latched and reliable) or not reliable
    assert ear.flow.qos.startswith("reliable" if reliable else "best_effort")
    assert not ear.flow.incompatible


@pytest.mark.parametrize(
    "second", [{"reliable": False}, {"latched": True}, {"reliable": False, "latched": True}]
)
@pytest.mark.parametrize("first", [{}, {"latched": True}])
def test_publishers_of_several_kinds_are_all_heard(ear, peer, first, second) -> None:
    """Whichever comes first; and the change of subscription loses and doubles nothing."""
    old = peer.publisher("/odom", ODOMETRY, **first)
    ear.look_until(old.get_subscription_count)
    said(ear, old)
    before = len(ear.heard)
    new = peer.publisher("/odom", ODOMETRY, **second)
    numbers = iter(range(200))

    def both():
        old.publish(odometry(next(numbers)))
        return new.get_subscription_count()

    ear.look_until(both)
    said(ear, old, new)
    sent = next(numbers)
    assert ear.bytes_on("/odom")[before:][:sent] == [odometry(n) for n in range(sent)]
    assert ear.flow.publishers == 2
    assert not ear.flow.incompatible


def test_a_transform_that_is_not_latched_on_tf_static_is_said(peer) -> None:
    """It would be heard only by those who listen already."""
    if find_spec("tf2_msgs") is None:
        pytest.skip("tf2_msgs is not there: `make tf`")
    ear = Ear(peer, Config())
    peer.publisher("/tf_static", TRANSFORMS)
    ear.look_until(lambda: "/tf_static" in ear.inputs.flows)
    assert "1 of 1 publishers offer volatile durability" in ear.inputs.flows["/tf_static"].incompatible
    good = peer.publisher("/tf_static", TRANSFORMS, latched=True)
    good.publish(b"anything")
    ear.look_until(lambda: ear.bytes_on("/tf_static"))
    assert "1 of 2 publishers" in ear.inputs.flows["/tf_static"].incompatible
    ear.inputs.close()


def test_a_topic_of_another_type_is_named(ear, peer) -> None:
    peer.publisher("/odom", "std_msgs/msg/String")
    ear.look_until(lambda: ear.inputs.unreadable)
    assert ear.inputs.unreadable == {"/odom": "std_msgs/msg/String"}


def test_without_sources_everything_that_could_be_one_is_heard(peer) -> None:
    """But not what another node of ours publishes, and what was found to be of no use."""
    ear = Ear(peer, Config(), finding=True)
    for topic in ("/odom", "/front/odometry", "/robot/slam_backend/odometry"):
        peer.publisher(topic, ODOMETRY)
    peer.publisher("/robot/slam_backend/map_to_odom", "geometry_msgs/msg/TransformStamped")
    peer.publisher("/chatter", "std_msgs/msg/String")
    ear.look_until(lambda: len(ear.inputs.flows) == 2)
    assert set(ear.inputs.flows) == {"/odom", "/front/odometry"}
    ear.inputs.ignore("/odom")
    ear.inputs.look(Config())
    assert set(ear.inputs.flows) == {"/front/odometry"}
    ear.inputs.close()


def test_no_configuration_is_needed(backend, peer, drive, tmp_path) -> None:
    """Odometry, and loops and landmarks that begin later; ground truth, a second odometry and a lidar are left aside."""
    node = backend()
    decisions = peer.hear("/slam_backend/decisions", "diagnostic_msgs/msg/DiagnosticArray")
    scan = Record("/lidar", CLOUD, 0, encode_cloud(START, "lidar", {axis: np.ones(1000) for axis in "xyz"}))
    odometries = [record for record in drive.records if record.topic == "/odom"]
    aside = [replace(odometries[0], topic="/ground_truth/odom"), scan]
    peer.play([*aside, *odometries[:200]])
    node.process.wait_for("/odom is used as odometry")
    for word in ("/ground_truth/odom is left aside: it is taken for ground truth", "/lidar is left aside"):
        node.process.wait_for(word)
    late = [record for record in drive.records if record.topic != "/odom" or record in odometries[200:]]
    peer.play([*late, replace(odometries[-1], topic="/wheels")])
    node.process.wait_for("/loops is used as relative")
    node.process.wait_for("/landmarks is used as landmark")
    node.process.wait_for("/wheels is left aside: 'odom' is the odometry")
    peer.until(lambda: decisions)
    summary = node.end()
    assert summary["run_hash"] == node.replayed()["run_hash"]
    assert summary["counts"]["records"] == len(drive.records)
    loops = sum(record.topic == "/loops" for record in drive.records)
    assert summary["counts"]["loops_offered"] == loops > 10
    assert summary["counts"]["landmarks"] > 5


@needs_tf2
@pytest.mark.slow
def test_without_an_odometry_topic_the_pair_on_tf_serves(backend, peer) -> None:
    """Found after a moment of waiting for a better one; other pairs on /tf are not kept."""
    node = backend()
    pose = peer.hear("/slam_backend/pose", POSE)
    records = []
    for n in range(80):
        stamp = START + n * SECOND // 10
        for parent, child in (("odom", "base_link"), ("base_link", "wheel")):
            data = encode_transforms(stamp, parent, {child: (0.1 * n, 0, 0, 0, 0, 0, 1)})
            records.append(Record("/tf", TRANSFORMS, stamp, data))
    peer.play(records, rate=1)
    node.process.wait_for("/tf is used as odometry")
    peer.until(lambda: pose)
    summary = node.end()
    assert summary["run_hash"] == node.replayed()["run_hash"]
    assert summary["counts"]["records"] == 80
    assert summary["counts"]["keyframes"] > 10


class Told:
    """The newest words of /diagnostics."""

    def __init__(self, peer):
        self._messages = peer.hear("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")

    def __getitem__(self, name):
        """Level, message and values of a status; empty before it was told."""
        for status in self._messages[-1].status if self._messages else ():
            if status.name == f"slam_backend: {name}":
                return status.level[0], status.message, {v.key: v.value for v in status.values}
        return -1, "", {}


@pytest.mark.slow
def test_diagnostics_say_how_everything_is(backend, peer, drive) -> None:
    """A source without publisher, a silent one, one that sends rubbish; what the solver does, with numbers."""
    node = backend(drive.config)
    told = Told(peer)
    peer.until(lambda: told["wheels"][1] == "no publisher on the topic")
    silent = peer.publisher("/odom", ODOMETRY)
    peer.until(lambda: told["wheels"][1] == "silent")
    assert told["wheels"][0] == 1
    peer.node.destroy_publisher(silent)
    peer.until(lambda: told["wheels"][1] == "its publisher is gone")
    alive = peer.play(drive.records[:600])
    peer.until(lambda: told["solver"][2].get("keyframes") and told["solver"][2]["queue"] == "0")
    level, message, values = told["solver"]
    assert (level, message) == (0, "solving")
    assert values["alive"] == "true"
    assert int(values["keyframes"]) > 300
    assert int(values["factors"]) > 300
    assert float(values["memory_mb"]) > 10
    assert 0 < float(values["update_ms_p50"]) <= float(values["update_ms_p99"])
    for name in ("correction_m", "correction_rad", "restarts", "revision", "incidents", "lost", "unwritten"):
        assert name in values
    assert {"nis", "nis_bounds", "noise"} <= told["wheels"][2].keys()  # looked at on the way
    for n in range(20):
        alive["/odom"].publish(odometry(n, x=float("nan")))
    peer.until(lambda: told["wheels"][2].get("check/not_finite") == "20")
    peer.until(lambda: told["wheels"][1].startswith("refused: check/not_finite"))
    assert told["wheels"][2]["qos"] == "reliable, volatile"
    assert float(told["wheels"][2]["rate_hz"]) >= 0
    peer.until(lambda: told["wheels"][1].startswith("silent for"))
    node.end()


@pytest.mark.slow
def test_poses_on_a_topic_of_their_own_wait_for_odometry(backend, peer) -> None:
    """A pose in the map, heard before any odometry, is a source once there is one; nothing of it is lost."""
    node = backend()
    pose = encode_pose_with_covariance(
        START + SECOND // 2, "map", (5, 5, 0, 0, 0, 0, 1), np.eye(6).ravel() * 1e-4
    )
    peer.play([Record("/localizer", POSE, 0, pose)])
    peer.play([Record("/odom", ODOMETRY, n, odometry(n)) for n in range(40)])
    node.process.wait_for("/localizer is used as pose")
    summary = node.end()
    assert summary["counts"]["records"] == 41
    assert summary["run_hash"] == node.replayed()["run_hash"]
    first = (node.folder / "run" / "trajectory.tum").read_text().splitlines()[0].split()
    assert abs(float(first[1]) - 4.5) < 0.3
