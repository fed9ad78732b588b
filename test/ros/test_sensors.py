"""Every kind of sensor through the node, as a user has it: what runs live is what the replay of its journal computes."""

import pytest

pytest.importorskip("rclpy")

import yaml

from slam_backend.io.bags import open_bag
from slam_backend.lab.simulate import Options, simulate, write_simulation

FIX, IMU, CLOUD = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu", "sensor_msgs/msg/PointCloud2"
DRIVES = {  # scenario, options, topics that are played (all of them: none named), what the configuration says instead
    "pixels": ("flight", Options(poses=60, landmarks=0, loop_rate=0.0), (), {}),
    "fixes alone": (
        "square", Options(poses=200, gnss_every=5, landmarks=0, loop_rate=0.0), ("/fix",),
        {"space": "2d", "sources": ["gps"], "gps": {"kind": "gnss", "topic": "/fix"}},
    ),
    "unmounted antenna": (
        "square", Options(poses=100, gnss_every=5, landmarks=0, loop_rate=0.0), ("/odom", "/fix"),
        {"space": "2d", "sources": ["wheels", "gps"], "wheels": {"kind": "odometry", "topic": "/odom"}, "gps": {"kind": "gnss", "topic": "/fix"}},
    ),
    "IMU and fixes": (
        "spiral", Options(poses=150, gnss_every=5, imu_rate=100.0, landmarks=0, loop_rate=0.0), ("/imu", "/fix"),
        {
            "space": "3d", "base_frame": "base", "extrinsics": {"antenna": [0.5, -0.25, 1.0, 0, 0, 0]}, "sources": ["imu", "gps"],
            "imu": {"kind": "imu", "topic": "/imu"}, "gps": {"kind": "gnss", "topic": "/fix", "keyframe": True},
        },
    ),
    "ranges": (
        "square", Options(poses=200, landmarks=6, landmark_form="range", landmark_range=30.0, loop_rate=0.0), (), {},
    ),
}  # fmt: skip


SAID = {  # of a source on /diagnostics, besides what is said of every source
    "gps": {"in_graph", "told", "withheld", "status", "since_s", "yaw", "sigma_yaw_rad"},
    "imu": {"in_graph", "bias_accelerometer", "bias_gyroscope", "sigma_bias_accelerometer", "sigma_bias_gyroscope"},
}  # fmt: skip


def keys_of(told, source):
    """Of the newest diagnostics of a source."""
    lines = [status for status in told[-1].status if status.name == f"slam_backend: {source}"] if told else []
    return {pair.key for status in lines for pair in status.values}


@pytest.fixture
def sensed(tmp_path):
    """`sensed(name)`: records of a simulated drive with those sensors, and the configuration."""

    def make(name):
        scenario, options, topics, instead = DRIVES[name]
        written = write_simulation(simulate(scenario, 4, options), tmp_path / "drive.mcap")
        with open_bag(written.bag) as bag:
            records = [r for r in bag.records() if (r.topic in topics if topics else r.topic != "/truth")]
        if instead:
            written.config.write_text(yaml.safe_dump(instead))
        return records, written.config

    return make


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("pixels", "pixels"),
        ("fixes alone", "gnss"),
        pytest.param("IMU and fixes", "imu", marks=pytest.mark.slow),
        pytest.param("ranges", "landmark", marks=pytest.mark.slow),
    ],
)
def test_what_a_sensor_says_live_is_what_replay_computes(backend, peer, sensed, name, kind) -> None:
    records, config = sensed(name)
    node = backend(config)
    poses = peer.hear("/slam_backend/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
    moving = peer.hear("/slam_backend/odometry", "nav_msgs/msg/Odometry")
    told = peer.hear("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    half = len(records) // 2
    peer.play(records[:half], rate=10)
    peer.until(lambda: poses)
    peer.play(records[half:], rate=10)
    peer.until(lambda: moving or name == "fixes alone")
    for source in {"gps", "imu"} & yaml.safe_load(config.read_text()).keys():
        peer.until(lambda source=source: keys_of(told, source) >= SAID[source])
    summary = node.end()
    offline = node.replayed()
    assert summary["counts"]["records"] == len(records)
    assert summary["run_hash"] == offline["run_hash"]
    assert summary["counts"] == offline["counts"]
    assert summary["counts"]["keyframes"] > 20
    assert kind in (node.folder / "run" / "config.yaml").read_text()
    for word in ("[ERROR]", "[WARN]"):
        assert word not in node.process.output


@pytest.mark.slow
def test_a_sensor_that_is_of_no_use_is_said_once_in_the_log(backend, peer, sensed) -> None:
    """Without looking at /diagnostics one learns what to configure."""
    records, config = sensed("unmounted antenna")
    node = backend(config)
    peer.play(records, rate=10)
    line = node.process.wait_for("[WARN]")
    assert "source 'gps': gnss/unknown_frame" in line
    assert "add it to 'extrinsics' or send it on /tf_static" in line
    peer.spin(2)
    summary = node.end()
    assert summary["run_hash"] == node.replayed()["run_hash"]
    assert node.process.output.count("[WARN]") == 1
