"""The life of the node: transitions over services, sessions, clocks."""

import signal
import sqlite3
from dataclasses import replace

import pytest

pytest.importorskip("rclpy")

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from std_srvs.srv import SetBool, Trigger

import slam_backend as sb
from slam_backend.core.measurement import SECOND
from slam_backend.io.bags import write_bag

ODOMETRY = "nav_msgs/msg/Odometry"


class Life:
    """Transitions and states of one node."""

    def __init__(self, peer, name="/slam_backend"):
        self._peer, self._name = peer, name

    def change(self, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return self._peer.call(ChangeState, f"{self._name}/change_state", request).success

    @property
    def state(self) -> str:
        return self._peer.call(GetState, f"{self._name}/get_state").current_state.label


@pytest.fixture
def life(peer):
    return Life(peer)


def rows(path):
    """Messages that were heard."""
    return (
        sqlite3.connect(path)
        .execute(
            "SELECT count(*) FROM messages m JOIN topics t ON t.id = topic_id WHERE t.name != '/slam_backend/session'"
        )
        .fetchone()[0]
    )


def test_a_whole_life(backend, peer, life, drive) -> None:
    """Inactive it neither listens nor publishes; active again the map goes on; cleaned up nothing is left but files."""
    node = backend(drive.config, settings=["autostart=false"])
    assert life.state == "unconfigured"
    assert not life.change(Transition.TRANSITION_ACTIVATE)
    assert not life.change(77)
    assert life.change(Transition.TRANSITION_CONFIGURE)
    assert not life.change(Transition.TRANSITION_CONFIGURE)
    heard = peer.hear("/slam_backend/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
    told = peer.hear("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    waiting = peer.publisher("/odom", ODOMETRY)
    peer.spin(1.5)
    assert not waiting.get_subscription_count()
    assert not told
    assert life.change(Transition.TRANSITION_ACTIVATE)
    peer.until(waiting.get_subscription_count)
    peer.node.destroy_publisher(waiting)
    half = len(drive.records) // 2
    peer.play(drive.records[:half])
    peer.until(lambda: heard)
    assert life.change(Transition.TRANSITION_DEACTIVATE)
    assert life.state == "inactive"
    peer.spin(0.5)
    heard.clear()
    waiting = peer.publisher("/odom", ODOMETRY)
    peer.spin(1)
    assert not waiting.get_subscription_count()
    peer.node.destroy_publisher(waiting)
    assert not heard
    assert life.change(Transition.TRANSITION_ACTIVATE)
    peer.play(drive.records[half:])
    peer.until(lambda: heard)
    children = [pid for pid, command in node.children.items() if "resource_tracker" not in command]
    assert len(children) == 2
    assert life.change(Transition.TRANSITION_DEACTIVATE)
    assert life.change(Transition.TRANSITION_CLEANUP)
    assert node.is_alone(children)
    assert node.summary["counts"]["keyframes"] == 600
    assert node.summary["run_hash"] == node.replayed()["run_hash"]
    assert life.change(Transition.TRANSITION_CONFIGURE)
    assert rows(node.folder / "journal-1.db3") >= len(drive.records)
    assert rows(node.folder / "journal.db3") == 0
    assert (node.folder / "run-1" / "summary.json").exists()
    assert not (node.folder / "run").exists()
    assert life.change(Transition.TRANSITION_INACTIVE_SHUTDOWN)
    assert life.state == "finalized"
    assert not life.change(Transition.TRANSITION_CONFIGURE)
    assert node.process.alive
    node.process.signal(signal.SIGINT)
    assert node.process.wait() == 0
    assert "Traceback" not in node.process.output


def test_a_folder_that_cannot_be_used_is_said_in_one_line(backend, peer, life, drive, tmp_path) -> None:
    """With exit code 2 where it starts itself; else the transition fails, and the node lives on."""
    (tmp_path / "file").write_text("")
    node = backend(drive.config, data="file/data")
    assert node.process.wait(20) == 2
    (line,) = node.process.output.splitlines()
    assert "file/data/journal.db3: cannot be used as journal" in line
    node = backend(drive.config, data="file/data", settings=["autostart=false"])
    assert not life.change(Transition.TRANSITION_CONFIGURE)
    assert life.state == "unconfigured"
    (tmp_path / "file").unlink()
    assert life.change(Transition.TRANSITION_CONFIGURE)
    assert life.change(Transition.TRANSITION_ACTIVATE)
    assert life.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)


def test_a_pause_outlasts_sessions(backend, peer, drive) -> None:
    """Whether the source or the pause comes first; a session that ends applies what it has kept."""
    node = backend()
    odometry = [record for record in drive.records if record.topic == "/odom"]
    pose = peer.hear("/slam_backend/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
    told = peer.hear("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    assert peer.call(SetBool, "/slam_backend/pause", SetBool.Request(data=True)).success
    peer.play(odometry[:100])
    peer.until(lambda: node.rows() == {"/odom": 100})
    peer.until(
        lambda: told and told[-1].status[-1].message == "paused; 102 records wait"
    )  # begin and configuration among them
    assert peer.call(Trigger, "/slam_backend/reset").success
    pose.clear()
    peer.play(odometry[100:150])
    peer.until(lambda: node.rows() == {"/odom": 50})
    peer.spin(0.5)
    assert not pose
    assert peer.call(SetBool, "/slam_backend/pause", SetBool.Request(data=False)).success
    peer.until(lambda: pose)
    assert node.end()["counts"]["records"] == 50
    assert node.replayed("-1")["counts"]["records"] == 100


@pytest.mark.slow
@pytest.mark.parametrize("choice", ["reset", "ignore"])
def test_a_bag_that_is_played_again(backend, peer, drive, tmp_path, choice) -> None:
    """The clock jumps back: the map starts anew and becomes what it was, or what is old is refused."""
    node = backend(drive.config, settings=[f"on_clock_jump={choice}"])
    part = drive.records[:600]
    decisions = peer.hear("/slam_backend/decisions", "diagnostic_msgs/msg/DiagnosticArray")
    peer.play(part)
    peer.spin(0.5)
    peer.play(part)
    node.process.wait_for(f"the clock of 'wheels' jumped back; on_clock_jump: {choice}")
    if choice == "reset":
        node.process.wait_for("a new session has begun")
        peer.spin(1)
    peer.until(lambda: any(s.name.startswith("incident/") for message in decisions for s in message.status))
    summary = node.end()
    assert summary["run_hash"] == node.replayed()["run_hash"]
    if choice == "ignore":
        assert summary["counts"]["keyframes"] == sum(record.topic == "/odom" for record in part)
        assert summary["decisions"]["settle/backward"] > 300
        return
    write_bag(tmp_path / "part.mcap", part)
    once = sb.replay(
        tmp_path / "part.mcap", sb.load_config(node.folder / "run" / "config.yaml")
    ).result.summary
    assert summary["run_hash"] == once["run_hash"]
    assert node.replayed("-1")["counts"]["keyframes"] == once["counts"]["keyframes"]


@pytest.mark.slow
def test_two_nodes_in_two_namespaces(backend, peer, drive) -> None:
    """Each with its own robot's topics; journal and configuration name them as the network does."""
    remap = [
        word for topic in ("odom", "loops", "landmarks", "tf_static") for word in ("-r", f"/{topic}:={topic}")
    ]
    nodes = {name: backend(drive.config, *remap, namespace=f"/{name}", data=name) for name in ("one", "two")}
    for name, count in (("one", 300), ("two", 500)):
        peer.play([replace(record, topic=f"/{name}{record.topic}") for record in drive.records[:count]])
    found = {}
    for name, node in nodes.items():
        found[name] = node.end()
        assert found[name]["run_hash"] == node.replayed()["run_hash"]
        config = sb.load_config(node.folder / "run" / "config.yaml")
        assert config.sources["wheels"].topic == f"/{name}/odom"
    assert found["one"]["counts"]["records"] == 300
    assert found["two"]["counts"]["records"] == 500


@pytest.mark.slow
def test_simulated_time(backend, peer, drive) -> None:
    """Diagnostics carry the time of /clock, which may stand or jump; what is computed does not depend on it."""
    from rosgraph_msgs.msg import Clock

    node = backend(drive.config, "-p", "use_sim_time:=true")
    told = peer.hear("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    clock = peer.publisher("/clock", "rosgraph_msgs/msg/Clock", depth=1)
    peer.until(clock.get_subscription_count)
    for seconds in (1000, 500):
        message = Clock()
        message.clock.sec = seconds

        def is_told(message=message):
            clock.publish(message)
            return told and told[-1].header.stamp == message.clock

        peer.until(is_told)
    peer.play(drive.records[:300])
    summary = node.end()
    assert summary["run_hash"] == node.replayed()["run_hash"]
    assert summary["counts"]["records"] == 300


@pytest.mark.slow
def test_a_full_disk_is_waited_out(backend, peer, drive) -> None:
    """The file may not grow any more: said once, in the diagnostics as well; the node goes on, and nothing is lost."""
    import resource

    node = backend(drive.config)
    told = peer.hear("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    heard = peer.hear("/slam_backend/odometry", ODOMETRY)
    pose = peer.hear("/slam_backend/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
    peer.play(drive.records[:200])
    peer.until(lambda: pose)
    size = (node.folder / "journal.db3-wal").stat().st_size
    resource.prlimit(node.process.pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    peer.play(drive.records[200:500])
    node.process.wait_for("cannot be written")
    heard.clear()

    def trouble():
        statuses = {status.name: status for message in told[-1:] for status in message.status}
        return "cannot be written" in statuses["slam_backend: solver"].message

    peer.until(trouble)
    peer.play(drive.records[500:600])
    peer.until(lambda: heard)
    resource.prlimit(
        node.process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    )
    peer.until(lambda: not trouble())
    summary = node.end()
    assert node.process.output.count("cannot be written") == 1
    assert summary["counts"]["records"] == rows(node.folder / "journal.db3")
    assert summary["run_hash"] == node.replayed()["run_hash"]
    config = sb.load_config(drive.config)
    assert summary["counts"]["keyframes"] == sum(
        r.topic == config.sources["wheels"].topic for r in drive.records[:600]
    )


@pytest.mark.slow
def test_time_stands_for_nobody(backend, peer, drive) -> None:
    """From the first odometry to the first pose: soon (how soon, `bench live` measures)."""
    node = backend(drive.config)
    pose = peer.hear("/slam_backend/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
    odometry = peer.publisher("/odom", ODOMETRY)
    peer.until(odometry.get_subscription_count)
    for record in [record for record in drive.records if record.topic == "/odom"][:20]:
        odometry.publish(bytes(record.data))
        peer.spin(0.1)
    peer.until(lambda: pose)
    assert pose[0].header.stamp.sec * SECOND > 0
    node.end()
