"""A bag that is played arrives byte for byte: at its pace, at the receivers' pace, and up to Ctrl-C."""

import hashlib
import json
import signal
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

pytest.importorskip("rclpy")

from slam_backend.cli import main
from slam_backend.core.measurement import SECOND
from slam_backend.io.bags import open_bag, write_bag
from slam_backend.io.encode import encode_odometry, encode_transforms
from slam_backend.io.records import Record
from slam_backend.ros.player import FASTEST, Player

RECEIVER = Path(__file__).parent / "receiver.py"
ODOMETRY, TF, CLOCK = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage", "rosgraph_msgs/msg/Clock"
START = 1_700_000_000 * SECOND
needs_tf2 = pytest.mark.skipif(find_spec("tf2_msgs") is None, reason="tf2_msgs is not there: `make tf`")


def odometry(count, hz=100, topic="/odom", seed=0):
    rng = np.random.default_rng(seed)
    for n in range(count):
        a, at = rng.normal(size=85), START + n * SECOND // hz
        yield Record(
            topic, ODOMETRY, at, encode_odometry(at, "odom", "base", a[:7], a[7:43], a[43:49], a[49:])
        )


def bag_of(folder, *records):
    path = folder / "drive.mcap"
    write_bag(path, sorted(records, key=lambda r: r.log_time))
    return path


def expected(path, topic):
    """What a receiver must tell that got every message of the topic, in order."""
    with open_bag(path) as bag:
        data = [record.data for record in bag.records({topic})]
    return [len(data), hashlib.sha256(b"".join(data)).hexdigest(), data[0].hex(), data[-1].hex()]


def received(process):
    process.end()
    return json.loads(process.output.splitlines()[-1])


@pytest.fixture
def receive(start):
    """`receive(TOPIC, TYPE, ...)`: a process that has subscribed."""

    def begin(*topics, depth=2000):
        process = start(RECEIVER, depth, *topics)
        process.wait_for("ready")
        return process

    return begin


def play(start, *arguments):
    return start("-m", "slam_backend", "play", *arguments)


def told(process):
    """What `play --json` said."""
    assert process.wait(30) == 0, process.output
    return json.loads(next(line for line in process.output.splitlines() if line.startswith("{")))


@pytest.fixture
def player():
    """`player(path, ...)`: a Player for every topic of the bag, in this process."""
    opened = []

    def build(path, topics=None, **options):
        bag = open_bag(path)
        made = Player(bag, topics or {name: name for name in bag.topics}, **options)
        opened.extend([made, bag])
        return made

    yield build
    for each in opened:
        each.__exit__(None, None, None)


def test_every_byte_arrives_in_order(tmp_path, start, receive):
    """Two topics at 5 times 200 Hz, one of them under another name."""
    path = bag_of(tmp_path, *odometry(1000, 200), *odometry(100, 20, "/loops", seed=1))
    receiver = receive("/wheels", ODOMETRY, "/loops", ODOMETRY)
    process = play(start, path, "--rate", 5, "--remap", "/odom:=/wheels", "--json")
    result = told(process)
    assert result["played"] == {"/loops": 100, "/wheels": 1000}
    assert result["seconds"] == pytest.approx(1.0, abs=0.5)
    assert received(receiver) == {"/wheels": expected(path, "/odom"), "/loops": expected(path, "/loops")}


def test_a_rosbag1_file_plays(tmp_path, start, receive):
    """Its bytes are turned into CDR on the way."""
    ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
    path = tmp_path / "old.bag"
    with Rosbag1Writer(path) as writer:
        connection = writer.add_connection("/odom", ODOMETRY, typestore=ros1)
        for n, record in enumerate(odometry(50)):
            message = ros2.deserialize_cdr(record.data, ODOMETRY)
            header = ros1.types["std_msgs/msg/Header"](seq=n, stamp=message.header.stamp, frame_id="odom")
            old = ros1.types[ODOMETRY](header, message.child_frame_id, message.pose, message.twist)
            writer.write(connection, record.log_time, ros1.serialize_ros1(old, ODOMETRY))
    receiver = receive("/odom", ODOMETRY)
    assert told(play(start, path, "--json"))["played"] == {"/odom": 50}
    found = received(receiver)["/odom"]
    assert found == expected(path, "/odom")
    assert bytes.fromhex(found[2]) == next(odometry(1)).data


def test_the_player_waits_for_its_receivers(tmp_path, start):
    """Nothing is published before each topic has one, so nothing is lost to who comes late."""
    path = bag_of(tmp_path, *odometry(100, 1000))
    process = play(start, path, "--json")
    time.sleep(1.5)
    receiver = start(RECEIVER, 2000, "/odom", ODOMETRY)
    assert told(process)["without_subscriber"] == []
    assert received(receiver)["/odom"] == expected(path, "/odom")


def test_a_topic_without_receiver_is_named_and_played_all_the_same(tmp_path, start):
    path = bag_of(tmp_path, *odometry(10, 1000))
    process = play(start, path, "--wait", 0.2)
    assert process.wait(20) == 0
    assert "note: nobody had subscribed to /odom at the start\n" in process.output
    assert "/odom: 10\nplayed 10 messages in" in process.output


@pytest.mark.slow
@needs_tf2
def test_static_transforms_reach_who_comes_later(tmp_path, start, receive):
    tf = Record("/tf_static", TF, START, encode_transforms(START, "base", {"camera": [0, 0, 1, 0, 0, 0, 1]}))
    path = bag_of(tmp_path, tf, *odometry(6000))
    receiver = receive("/odom", ODOMETRY)
    process = play(start, path, "--wait", 2)
    receiver.wait_for("first of /odom")
    late = receive("/tf_static", TF)
    late.wait_for("first of /tf_static")
    assert process.alive
    assert received(late)["/tf_static"] == expected(path, "/tf_static")


def test_the_clock_goes_with_the_log(tmp_path, start, receive):
    """About 100 times a second of ours, within the log's own times, at twice their speed."""
    path = bag_of(tmp_path, *odometry(20, 10))
    receiver = receive("/odom", ODOMETRY, "/clock", CLOCK)
    told(play(start, path, "--clock", "--rate", 2, "--json"))
    count, _, first, last = received(receiver)["/clock"]
    times = [int.from_bytes(bytes.fromhex(x)[4:8], "little") * SECOND for x in (first, last)]
    times = [
        t + int.from_bytes(bytes.fromhex(x)[8:12], "little")
        for t, x in zip(times, (first, last), strict=True)
    ]
    assert START <= times[0] <= times[1] <= START + 19 * SECOND // 10
    assert times[1] - times[0] > SECOND
    assert 50 < count < 200


@pytest.mark.slow
def test_a_receiver_that_stands_still_makes_the_player_wait(tmp_path, start, receive):
    """Stopped for 2 s at 1,000 Hz with queues of 500: the queue would have run over four times."""
    path = bag_of(tmp_path, *odometry(2000, 1000))
    receiver = receive("/odom", ODOMETRY, depth=500)
    process = play(start, path, "--depth", 500, "--json")
    receiver.wait_for("first of /odom")
    receiver.signal(signal.SIGSTOP)
    time.sleep(2)
    receiver.signal(signal.SIGCONT)
    assert told(process)["seconds"] > 2.5
    assert received(receiver)["/odom"] == expected(path, "/odom")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_it_at_once_and_nothing_played_is_lost(tmp_path, start, receive, number):
    path = bag_of(tmp_path, *odometry(6000))
    receiver = receive("/odom", ODOMETRY)
    process = play(start, path)
    receiver.wait_for("first of /odom")
    time.sleep(1)
    begin = time.monotonic()
    process.signal(number)
    assert process.wait(5) == -signal.SIGINT  # so Process tells the exit code 130
    assert time.monotonic() - begin < 2
    (line,) = [line for line in process.output.splitlines() if line.startswith("/odom: ")]
    count = int(line.removeprefix("/odom: "))
    assert 50 < count < 300
    assert received(receiver)["/odom"][0] == count
    assert "Traceback" not in process.output


@pytest.mark.parametrize(("rate", "seconds"), [(1.0, 0.5), (5.0, 0.1), (0.0, 50 / FASTEST)])
def test_the_rate_is_that_of_the_log(tmp_path, player, rate, seconds):
    """50 messages of 100 Hz; at rate 0 the log times do not matter."""
    made = player(bag_of(tmp_path, *odometry(50)))
    begin = time.monotonic()
    assert len(list(made.play(rate))) == 50
    assert time.monotonic() - begin == pytest.approx(seconds, abs=0.08)


def test_time_lost_is_not_made_up_for(tmp_path, player):
    """Who holds the player up gets no flood afterwards."""
    made = player(bag_of(tmp_path, *odometry(40)))
    at = []
    for n, _ in enumerate(made.play()):
        at.append(time.monotonic())
        if n == 10:
            time.sleep(0.3)
    assert at[-1] - at[11] == pytest.approx(0.28, abs=0.06)


def test_what_cannot_be_played_is_said_in_a_line_each(tmp_path, player):
    """A type that this ROS lacks, one that the bag defines otherwise, a name that ROS 2 refuses, and /clock twice."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.fielddefs.pop("std_msgs/msg/Int32")
    store.types.pop("std_msgs/msg/Int32")
    store.register(get_types_from_msg("int64 data\n", "std_msgs/msg/Int32"))
    store.register(get_types_from_msg("int32 state\n", "acme_msgs/msg/Lamp"))
    (good,) = odometry(1)
    records = [
        Record("/ball", "std_msgs/msg/Int32", START, b"\0\1\0\0" + bytes(8)),
        Record("/clock", CLOCK, START, b"\0\1\0\0" + bytes(8)),
        Record("/lamp", "acme_msgs/msg/Lamp", START, b"\0\1\0\0" + bytes(4)),
        good,
    ]
    path = tmp_path / "odd.mcap"
    write_bag(path, records, store)
    made = player(path, {"/ball": "/ball", "/clock": "/clock", "/lamp": "/lamp", "/odom": "/a-b"}, clock=True)
    assert made.skipped == [
        "/ball (std_msgs/msg/Int32): the bag defines the type otherwise, and receivers would misread it",
        "/clock (rosgraph_msgs/msg/Clock): the player publishes its own",
        "/lamp (acme_msgs/msg/Lamp): this ROS does not have the type",
        "/odom (nav_msgs/msg/Odometry): '/a-b' is no topic name in ROS 2; give it another with --remap",
    ]
    assert list(made.play()) == []


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--topics", "/odm"], "--topics /odm: the bag has no such topic; did you mean '/odom'?"),
        (["--remap", "/odom"], "--remap /odom: write OLD:=NEW, for instance /odom:=/wheels/odom"),
        (["--remap", "/imu:=/x"], "--remap /imu:=/x: no topic '/imu' is played; there are /odom"),
        (["--depth", "10"], "Invalid value for '--depth'"),
        (
            ["--remap", "/odom:=/a-b"],
            "nothing to play: /odom (nav_msgs/msg/Odometry): '/a-b' is no topic name in ROS 2",
        ),
    ],
)
def test_a_wrong_option_gets_one_line(tmp_path, capsys, arguments, says):
    path = bag_of(tmp_path, *odometry(3))
    assert main(["play", str(path), *arguments]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
