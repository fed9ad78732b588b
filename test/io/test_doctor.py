"""The doctor judges a recording by the firewall's table, whatever the recording lacks."""

from pathlib import Path

import numpy as np
import pytest

from slam_backend.cli import main
from slam_backend.core.config import config_from
from slam_backend.core.measurement import SECOND
from slam_backend.io.bags import open_bag, write_bag
from slam_backend.io.doctor import Checkup, examine, worst
from slam_backend.io.encode import encode_odometry, encode_string, encode_transforms
from slam_backend.io.qos import offered_qos
from slam_backend.io.records import Record
from slam_backend.io.replay import replay
from slam_backend.io.typestore import typestore_of

DATA = Path(__file__).parents[2] / "../shared/data/bags"
ZERO = np.zeros((6, 6))
CONFIG = config_from({"space": "2d", "sources": ["wheels"], "wheels": {"kind": "odometry", "topic": "/odom"}})


def odometry(n: int, stamp: int | None = None, x: float | None = None, turn: float = 1.0) -> Record:
    """Number n of a drive at 10 Hz and 1 m/s."""
    at = (n + 10) * SECOND // 10
    pose = (n / 10 if x is None else x, 0.0, 0.0, 0.0, 0.0, 0.0, turn)
    data = encode_odometry(at if stamp is None else stamp, "odom", "base", pose, ZERO, np.zeros(6), ZERO)
    return Record("/odom", "nav_msgs/msg/Odometry", at, data)


def checked(folder: Path, records: list[Record], config=None) -> Checkup:
    write_bag(folder / "bag.mcap", records)
    return examine([folder / "bag.mcap"], config)


def test_a_sound_recording_has_nothing_to_mend(tmp_path):
    found = checked(tmp_path, [odometry(n) for n in range(50)])
    (odom,) = found.topics
    assert (odom.name, odom.use, odom.messages, odom.refused, odom.severity) == (
        "/odom",
        "odometry",
        50,
        {},
        None,
    )
    assert odom.rate == pytest.approx(10)
    assert not found.serious


def test_each_rule_that_was_broken_is_counted_with_what_to_do(tmp_path):
    drive = [odometry(n) for n in range(200)]
    drive[20], drive[40], drive[60] = odometry(20, x=np.nan), odometry(40, x=1e4), odometry(60, stamp=1 << 60)
    found = checked(tmp_path, [*drive[:100], *drive[130:]], CONFIG)
    (odom,) = found.topics
    assert odom.refused == {"check/not_finite": 1, "recheck/teleport": 1, "settle/jump": 1}
    assert (odom.gaps, odom.severity, found.serious) == (1, "warn", False)
    said = " ".join(f"{finding.what}; {finding.advice}" for finding in odom.findings)
    for words in ("1 x check/not_finite", "max_speed", "header.stamp", "the longest 3.1 s"):
        assert words in said


def test_what_makes_a_source_useless_is_serious(tmp_path):
    found = checked(tmp_path, [odometry(n, turn=0.0) for n in range(20)], CONFIG)
    assert found.topics[0].refused == {"check/quaternion": 20}
    assert found.serious
    assert "not one of its measurements can be used" in {f.what for f in found.topics[0].findings}


def test_a_tenth_refused_is_serious_by_whatever_rule(tmp_path):
    drive = [odometry(n, x=np.nan if n % 8 == 3 else None) for n in range(80)]
    assert checked(tmp_path, drive, CONFIG).serious


def test_topics_that_no_source_uses_are_listed_with_what_could_use_them(tmp_path):
    words = Record("/chatter", "std_msgs/msg/String", 7, encode_string("hello"))
    other = [Record("/visual_odom", r.type, r.log_time, r.data) for r in (odometry(n) for n in range(5))]
    found = checked(tmp_path, [words, *other, *(odometry(n) for n in range(20))], CONFIG)
    unused = {topic.name: topic.findings[0].what for topic in found.topics if not topic.use}
    assert unused["/chatter"] == "no source reads this type"
    assert "could be odometry" in unused["/visual_odom"]
    assert not found.serious


def test_without_anything_that_drives_there_is_still_an_answer(tmp_path):
    found = checked(tmp_path, [Record("/chatter", "std_msgs/msg/String", 7, encode_string("hello"))])
    assert [topic.name for topic in found.topics] == ["/chatter"]
    assert found.serious
    assert found.findings[0].what == "nothing in it can drive the keyframes"


def test_a_frame_that_nobody_mounts_is_found_without_solving(tmp_path):
    config = config_from(
        {"sources": ["wheels", "loops"], "wheels": {"kind": "odometry", "topic": "/odom"}, "loops": {"kind": "relative", "topic": "/l"}}
    )  # fmt: skip
    pose = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    data = encode_odometry(3 * SECOND, "lidar@2.0", "lidar@3.0", pose, np.eye(6), np.zeros(6), ZERO)
    loop = Record("/l", "nav_msgs/msg/Odometry", 3 * SECOND, data)
    found = checked(tmp_path, [*(odometry(n) for n in range(30)), loop], config)
    loops = next(topic for topic in found.topics if topic.name == "/l")
    assert loops.refused == {"relative/unknown_frame": 1}
    assert loops.severity == "error"
    assert any("(lidar)" in finding.what for finding in loops.findings)


def test_damage_is_serious(tmp_path):
    write_bag(tmp_path / "whole.mcap", [odometry(n) for n in range(500)])
    whole = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    found = examine([tmp_path / "cut.mcap"])
    assert worst(found.findings) == "error"
    assert found.serious


def test_the_doctor_sees_what_replay_refuses(tmp_path):
    """One validator: the counts are those of the decisions of a replay."""
    from slam_backend.io.replay import replay

    drive = [
        odometry(n, x=np.nan if n % 9 == 3 else None, turn=0.5 if n % 11 == 5 else 1.0) for n in range(200)
    ]
    found = checked(tmp_path, [*drive[:50], drive[49], *drive[50:]], CONFIG)
    told = replay(tmp_path / "bag.mcap", CONFIG).result.summary["decisions"]
    assert found.topics[0].refused == {
        id_: n for id_, n in told.items() if id_.partition("/")[0] in ("check", "settle", "recheck")
    }


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("- {reliability: 1, durability: 2}", "reliable, volatile"),
        ("- {reliability: best_effort, durability: transient_local}", "best_effort, transient_local"),
        ("- {reliability: 1, durability: 1}\n- {reliability: 2, durability: 1}", "best_effort, transient_local"),
        ("", ""), ("[1, 2]", ""), ("{", ""), ("- {reliability: [7]}", ""),
    ],
)  # fmt: skip
def test_what_publishers_offered_is_read_in_numbers_and_words(text, words):
    assert offered_qos(text) == words


VERDICTS = {  # bag -> (source in use, serious)
    "evo/ROS_example.bag": ("ORB-SLAM", False),
    "evo/nav2_turtlebot.mcap": ("/odom", False),
    "evo/tf_example": ("/tf", False),
    "fuse_turtlebot3/turtlebot3.bag": ("/odom", False),
    "plotjuggler/tilt_laser.bag": ("", False),  # only an old tf type, but fixes
    "robot_localization/test1.bag": ("/husky_velocity_controller/odom", False),
    "rosbagjs/example-bz2.bag": ("", True),
    "rosbag2/bags/only_services.mcap": ("", True),
    "rosbag2/ros2bag/test/resources/empty_bag": ("", True),
}


@pytest.mark.skipif(not DATA.exists(), reason="needs ../shared/data")
@pytest.mark.parametrize("name", VERDICTS)
def test_real_recordings_get_a_true_verdict(name):
    found = examine([DATA / name])
    source, serious = VERDICTS[name]
    assert [t.name for t in found.topics if t.use == "odometry"] == [source][: len(source)]
    assert found.serious is serious
    with open_bag(DATA / name) as bag:
        assert {t.name: t.messages for t in found.topics} == {
            name: topic.count for name, topic in bag.topics.items()
        }
    assert not any(topic.refused for topic in found.topics)


STORE = typestore_of(())


def imu(n: int, acceleration) -> Record:
    vector, header = STORE.types["geometry_msgs/msg/Vector3"], STORE.types["std_msgs/msg/Header"]
    time, turn = STORE.types["builtin_interfaces/msg/Time"], STORE.types["geometry_msgs/msg/Quaternion"]
    message = STORE.types["sensor_msgs/msg/Imu"](
        header(time(1, n * 10_000_000), "imu_link"), turn(0.0, 0.0, 0.0, 1.0), np.zeros(9),
        vector(0.0, 0.0, 0.0), np.zeros(9), vector(*acceleration), np.zeros(9),
    )  # fmt: skip
    data = bytes(STORE.serialize_cdr(message, "sensor_msgs/msg/Imu"))
    return Record("/imu", "sensor_msgs/msg/Imu", SECOND + n * SECOND // 100, data)


def mounting(seven) -> Record:
    return Record(
        "/tf_static", "tf2_msgs/msg/TFMessage", SECOND,
        encode_transforms(SECOND, "base_link", {"imu_link": seven}),
    )  # fmt: skip


@pytest.mark.parametrize("others", [[], [odometry(n) for n in range(20)]], ids=["alone", "with odometry"])
@pytest.mark.parametrize(
    ("acceleration", "odd"),
    [((0.1, 0.2, 9.8), False), ((-9.8, 0.2, 0.1), True), ((0.1, 0.0, -9.8), True), ((0.3, 0.1, 0.0), False)],
    ids=["upright", "on its side", "upside down", "gravity taken out"],
)
def test_an_imu_that_lies_on_its_side_is_said_without_a_configuration(tmp_path, acceleration, odd, others):
    found = checked(tmp_path, [*(imu(n, acceleration) for n in range(50)), *others])
    (topic,) = (topic for topic in found.topics if topic.name == "/imu")
    assert any("imu/sideways" in finding.what for finding in topic.findings) == odd


def test_an_imu_whose_mounting_is_told_may_lie_as_it_wants(tmp_path):
    half = np.sqrt(0.5)
    told = mounting((0.0, 0.0, 0.0, 0.0, half, 0.0, half))  # its x axis points down
    found = checked(tmp_path, [told, *(imu(n, (-9.8, 0.2, 0.1)) for n in range(50))])
    assert not any("imu/sideways" in finding.what for topic in found.topics for finding in topic.findings)


def test_an_imu_on_its_side_that_nothing_uses_is_said_on_the_terminal(tmp_path, capsys):
    """By `doctor`, and by `replay` with a configuration that leaves it out."""
    records = [*(imu(n, (9.8, 0.1, 0.2)) for n in range(50)), *(odometry(n) for n in range(20))]
    write_bag(tmp_path / "tilted.mcap", sorted(records, key=lambda record: record.log_time))
    assert main(["doctor", str(tmp_path / "tilted.mcap")]) == 0
    out = capsys.readouterr().out
    assert next(line for line in out.splitlines() if line.startswith("/imu ")).endswith("look")
    assert "warn: /imu: imu/sideways" in out
    wheels = config_from({"sources": ["wheels"], "wheels": {"kind": "odometry", "topic": "/odom"}})
    (note,) = replay(tmp_path / "tilted.mcap", wheels).notes
    assert note.startswith("/imu is not used (imu/sideways)")


def test_an_upright_imu_is_worth_no_note(tmp_path):
    write_bag(
        tmp_path / "upright.mcap", [*(imu(n, (0.1, 0.2, 9.8)) for n in range(50)), *map(odometry, range(20))]
    )
    wheels = config_from({"sources": ["wheels"], "wheels": {"kind": "odometry", "topic": "/odom"}})
    assert replay(tmp_path / "upright.mcap", wheels).notes == []
