"""run.mcap: a finished run that any ROS tool plays, corrected, alone or with its inputs."""

import numpy as np
import pytest
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader

from slam_backend.cli import main
from slam_backend.core.geometry import matrix_of, seven_of_matrix
from slam_backend.io.bags import open_bag, write_bag
from slam_backend.io.configfile import load_config
from slam_backend.io.encode import encode_transforms
from slam_backend.io.records import Record
from slam_backend.io.replay import replay
from slam_backend.io.resultbag import write_result_bag
from slam_backend.io.rundir import write_run
from slam_backend.lab.simulate import Options, simulate, write_simulation

TF = "tf2_msgs/msg/TFMessage"
LATER = 1_000_000  # ns; of the simulated odometry


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    options = Options(poses=200, loop_rate=0.5, landmarks=20)
    return write_simulation(simulate("square", 3, options), tmp_path_factory.mktemp("drive") / "drive.mcap")


@pytest.fixture(scope="module")
def result(drive):
    return replay(drive.bag, load_config(drive.config)).result


def read(bag, topic):
    """(log time, message) of a topic."""
    return [(r.log_time, bag.typestore.deserialize_cdr(r.data, r.type)) for r in bag.records({topic})]


def seven(transform):
    p, q = transform.translation, transform.rotation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])


def test_transforms_put_the_robot_where_the_finished_run_has_it(result, tmp_path):
    write_result_bag(result, tmp_path, "link")
    found = {"map": {}, "odom": {}}
    with open_bag(tmp_path / "run.mcap") as bag:
        for log_time, message in read(bag, "/tf"):
            (one,) = message.transforms
            stamp = one.header.stamp.sec * 10**9 + one.header.stamp.nanosec
            assert 0 <= log_time - stamp - LATER < 10  # as the inputs were logged
            found[one.header.frame_id][stamp] = (one.child_frame_id, seven(one.transform))
    assert {child for child, _ in found["map"].values()} == {"odom"}
    assert {child for child, _ in found["odom"].values()} == {"base"}
    stamps = result.trajectory.stamps.tolist()
    assert sorted(found["map"]) == stamps
    chained = [matrix_of(found["map"][s][1]) @ matrix_of(found["odom"][s][1]) for s in stamps]
    np.testing.assert_allclose(
        seven_of_matrix(np.array(chained))[:, :3], result.trajectory.sevens[:, :3], atol=1e-9
    )


def test_the_map_comes_first_and_every_decision_at_its_moment(result, tmp_path):
    write_result_bag(result, tmp_path, "link")
    with open_bag(tmp_path / "run.mcap") as bag:
        first = [record.topic for record, _ in zip(bag.records(), range(4), strict=False)]
        assert {f"/slam_backend/{name}" for name in ("path", "trajectory", "landmarks", "graph")} == set(
            first
        )
        ((_, path),) = read(bag, "/slam_backend/path")
        ((_, landmarks),) = read(bag, "/slam_backend/landmarks")
        decisions = read(bag, "/slam_backend/decisions")
    assert len(path.poses) == len(result.trajectory)
    assert path.header.frame_id == "map"
    assert landmarks.width == len(result.snapshot.names) > 5
    told = sorted(result.decisions, key=lambda d: d.stamp)
    assert [status.name for _, m in decisions for status in m.status] == [d.id for d in told]
    assert len(told) > 10


def test_players_keep_the_map_for_those_who_come_late(result, tmp_path):
    write_result_bag(result, tmp_path, "copy")
    with Reader(tmp_path / "run.mcap") as reader:
        durable = {c.topic for c in reader.connections for q in c.ext.offered_qos_profiles
                   if q.durability is QosDurability.TRANSIENT_LOCAL}  # fmt: skip
    assert durable == {f"/slam_backend/{name}" for name in ("path", "trajectory", "landmarks", "graph")}


def test_copied_inputs_are_there_to_the_byte(result, drive, tmp_path):
    write_result_bag(result, tmp_path, "copy")
    with open_bag(drive.bag) as before, open_bag(tmp_path / "run.mcap") as after:
        assert set(before.topics) < set(after.topics)
        for topic in before.topics:
            pairs = zip(before.records({topic}), after.records({topic}), strict=True)
            assert all(one.data == two.data and abs(one.log_time - two.log_time) < 1000 for one, two in pairs)
        times = [record.log_time for record in after.records()]
    assert times == sorted(set(times))


def test_the_odometry_s_frame_has_one_parent(drive, tmp_path):
    """A recording in which a localizer said map -> odom, and the wheels odom -> base, along with something else."""
    identity = np.array([0, 0, 0, 0, 0, 0, 1.0])
    with open_bag(drive.bag) as bag:
        records = [record for record in bag.records() if record.topic != "/truth"]
    localizer = [
        Record("/tf", TF, r.log_time + 10, encode_transforms(r.log_time, "world", {"odom": identity, "cup": identity}))
        for r in records if r.topic == "/odom"
    ]  # fmt: skip
    wheels = [
        Record("/tf", TF, r.log_time + 20, encode_transforms(r.log_time, "/odom", {"base": identity}))
        for r in records if r.topic == "/odom"
    ]  # fmt: skip
    path = tmp_path / "with_tf.mcap"
    write_bag(
        path, sorted([*records, *localizer, *wheels], key=lambda r: r.log_time), strictly_increasing=True
    )
    write_result_bag(replay(path, load_config(drive.config)).result, tmp_path, "copy")
    with open_bag(tmp_path / "run.mcap") as bag:
        pairs = {(t.header.frame_id, t.child_frame_id) for _, m in read(bag, "/tf") for t in m.transforms}
    assert pairs == {("map", "odom"), ("/odom", "base"), ("world", "cup")}


def test_a_pose_graph_has_a_bag_too(tmp_path):
    edges = [f"EDGE_SE2 {k} {k + 1} 1 0 0.1 100 0 0 100 0 100" for k in range(5)]
    (tmp_path / "graph.g2o").write_text("\n".join([*edges, "EDGE_SE2 0 5 4 1 0.5 1 0 0 1 0 1", ""]))
    write_result_bag(replay(tmp_path / "graph.g2o").result, tmp_path, "copy")
    with open_bag(tmp_path / "run.mcap") as bag:
        assert bag.topics["/tf"].count == 12


def test_the_command_links_or_copies_and_replaces_what_it_wrote(drive, tmp_path):
    command = [
        "replay",
        str(drive.bag),
        "--config",
        str(drive.config),
        "--no-report",
        "--out",
        str(tmp_path / "run"),
    ]
    assert main([*command, "--bag", "link"]) == 0
    link = tmp_path / "run/inputs/drive.mcap"
    assert link.is_symlink()
    assert link.read_bytes() == drive.bag.read_bytes()
    small = (tmp_path / "run/run.mcap").stat().st_size
    assert main([*command, "--bag", "copy"]) == 0
    assert not link.exists()
    assert (tmp_path / "run/run.mcap").stat().st_size > small
    write_run(replay(drive.bag, load_config(drive.config)).result, tmp_path / "run")
    assert not (tmp_path / "run/run.mcap").exists()
    (tmp_path / "run/inputs/thesis.tex").write_text("years")
    assert main(command) == 2
    assert (tmp_path / "run/inputs/thesis.tex").exists()
