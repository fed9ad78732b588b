"""Every kind of sensor through the node, as a user has it: what runs live is what the replay of its journal computes."""

import json
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

import yaml
from nav_msgs.srv import LoadMap
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters
from std_srvs.srv import Trigger

from slam_backend.core.measurement import format_stamp
from slam_backend.io.bags import open_bag
from slam_backend.io.finished import FinishedRun
from slam_backend.lab.simulate import Options, simulate, write_simulation

FIX, IMU, CLOUD = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu", "sensor_msgs/msg/PointCloud2"
DRIVES = {  # scenario, options, topics that are played (all of them: none named), what the configuration says instead
    "pixels": ("flight", Options(poses=60, landmarks=0, loop_rate=0.0), (), {}),
    "fixes alone": (
        "square", Options(poses=200, gnss_every=5, landmarks=0, loop_rate=0.0), ("/fix",),
        {"space": "2d", "sources": ["gps"], "gps": {"kind": "gnss", "topic": "/fix"}},
    ),
    "fixes": ("square", Options(poses=500, gnss_every=5, landmarks=0, loop_rate=0.0), (), {}),
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


def asked(peer, *names):
    """What ~/query answers, in order: a list of numbers, what a JSON text says, or None."""
    request = GetParameters.Request(names=list(names))
    values = peer.call(GetParameters, "/slam_backend/query", request).values
    read = {ParameterType.PARAMETER_STRING: lambda v: json.loads(v.string_value),
            ParameterType.PARAMETER_DOUBLE_ARRAY: lambda v: list(v.double_array_value)}  # fmt: skip
    return [read[v.type](v) if v.type in read else None for v in values]


@pytest.mark.slow
def test_the_earth_is_told_over_the_service_and_joins_the_drives_of_a_saved_map(
    backend, peer, sensed
) -> None:
    """Unknown with the reason at first, then as the run says; a map that is loaded is joined by the fixes of the new drive."""
    records, config = sensed("fixes")
    node = backend(config)
    few, half = 10, len(records) // 2
    peer.play(records[:few], rate=10)
    peer.until(lambda: asked(peer, "earth")[0])
    early, place = asked(peer, "earth", "place@now")
    assert early["map_T_earth"] is None
    assert "yaw not yet observable" in early["why"]
    assert place is None
    peer.play(records[few:half], rate=10)
    peer.until(lambda: asked(peer, "earth")[0]["map_T_earth"])
    saved = json.loads(peer.call(Trigger, "/slam_backend/save").message)
    run = Path(saved["run"])
    known, place, then = asked(peer, "earth", "place@now", f"map@{records_end(run)}/earth")
    finished = FinishedRun(run)
    assert known["origin"] == finished.summary["earth"]["origin"] == then["origin"]
    assert known["map_T_earth"] == pytest.approx(finished.summary["earth"]["map_T_earth"], abs=1e-3)
    assert place[:2] == pytest.approx(known["origin"][:2], abs=1e-2)  # degrees: the drive is small
    answer = peer.call(LoadMap, "/slam_backend/load", LoadMap.Request(map_url=f"runs/{run.name}"))
    assert answer.result == LoadMap.Response.RESULT_SUCCESS
    peer.play(records[half:], rate=10)
    summary = node.end()
    assert summary["counts"]["parts"] == 1
    assert summary["decisions"]["gnss/joined"] == 1
    assert len(summary["sessions"]) == 2
    assert summary["earth"]["origin"] == known["origin"]
    assert summary["run_hash"] == node.replayed()["run_hash"]


def records_end(run):
    """Where a run ends, as a stamp in words."""
    return format_stamp(int(FinishedRun(run).trajectory.stamps[-1]))


@pytest.mark.slow
def test_a_topic_that_is_never_heard_is_said_once_in_the_log(backend, peer, sensed) -> None:
    """One that nobody publishes, and one that is published and stays silent; not one that was heard once."""
    records, config = sensed("unmounted antenna")
    given = yaml.safe_load(config.read_text())
    config.write_text(
        yaml.safe_dump(
            given | {"sources": ["wheels", "gps", "tags"], "tags": {"kind": "landmark", "topic": "/tags"}}
        )
    )
    node = backend(config)
    dumb = peer.publisher("/tags", CLOUD)
    peer.play([record for record in records if record.topic == "/odom"], rate=10)
    told = node.process.wait_for("source 'gps'") + node.process.wait_for("source 'tags'")
    peer.spin(2)
    node.end()
    assert "source 'gps': nothing heard yet on /fix: it has no publisher" in told
    assert "source 'tags': nothing heard yet on /tags: 1 publish it and send nothing" in told
    assert node.process.output.count("[WARN]") == 2
    peer.node.destroy_publisher(dumb)
