"""Bytes become measurements, by the short way and the long way alike; nonsense becomes a decision."""

from dataclasses import fields

import numpy as np
import pytest

from slam_backend.core.graph import Decision
from slam_backend.core.measurement import Measurement, format_stamp
from slam_backend.core.sensors.landmark import LandmarkObservation
from slam_backend.core.sensors.odometry import OdometryPose
from slam_backend.core.sensors.relative import RelativePose
from slam_backend.io import cdr
from slam_backend.io.cdr import Decoder
from slam_backend.io.encode import encode_cloud, encode_odometry, encode_pose_with_covariance
from slam_backend.io.records import Record
from slam_backend.io.typestore import typestore_of

STORE = typestore_of(())
ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
COVARIANCE, CLOUD = "geometry_msgs/msg/PoseWithCovarianceStamped", "sensor_msgs/msg/PointCloud2"
TABLE = {
    "/odom": ("wheels", "odometry"),
    "/loops": ("loops", "relative"),
    "/tags": ("tags", "landmark"),
    "/pose": ("amcl", "pose"),
}
STAMP = 1_700_000_000_000_000_001


def odometry(rng, frame="odom", child="base") -> bytes:
    n = rng.normal(size=85)
    return encode_odometry(int(rng.integers(0, 2**60)), frame, child, n[:7], n[7:43], n[43:49], n[49:])


def loop(rng, stamp_i=5, stamp_j=7 * 10**9) -> bytes:
    return odometry(rng, f"base@{format_stamp(stamp_i)}", f"base@{format_stamp(stamp_j)}")


def pose(rng, frame="odom") -> bytes:
    """A PoseStamped is a PoseWithCovarianceStamped without its last 36 numbers."""
    data = encode_pose_with_covariance(int(rng.integers(0, 2**60)), frame, rng.normal(size=7), np.zeros(36))
    return data[: -36 * 8]


def landmarks(rng) -> bytes:
    columns = {
        "id": np.arange(4, dtype=np.uint32),
        **{a: rng.normal(size=4) for a in "xyz"},
        "sigma": np.ones(4),
    }
    return encode_cloud(STAMP, "camera", columns)


def decoded(topic, name, data):
    return Decoder(STORE, TABLE).decode(Record(topic, name, 9, data))


def same(one, other) -> bool:
    """Equal types and equal fields, arrays bit by bit."""
    values = [(getattr(one, f.name), getattr(other, f.name)) for f in fields(one)]
    return type(one) is type(other) and all(
        a.tobytes() == b.tobytes() and a.shape == b.shape if isinstance(a, np.ndarray) else a == b
        for a, b in values
    )


@pytest.mark.parametrize(
    ("topic", "name", "make"),
    [
        ("/odom", ODOMETRY, lambda rng, text: odometry(rng, text(), text())),
        ("/odom", POSE, lambda rng, text: pose(rng, text())),
        (
            "/odom",
            COVARIANCE,
            lambda rng, text: encode_pose_with_covariance(STAMP, text(), np.ones(7), rng.normal(size=36)),
        ),
        ("/loops", ODOMETRY, lambda rng, _: loop(rng, *map(int, rng.integers(0, 2**60, 2)))),
    ],
)
def test_the_short_way_and_the_long_way_agree(topic, name, make, monkeypatch) -> None:
    """On 300 random messages with names of every length, so at every alignment, with 0 to 3 bytes of padding."""
    rng = np.random.default_rng(1)

    def text():
        return "".join(rng.choice(list("abcdeü/_"), rng.integers(0, 20)))

    messages = [make(rng, text) + bytes(rng.integers(0, 4)) for _ in range(300)]
    ways = []
    for short in (True, False):
        if not short:
            monkeypatch.setattr(cdr, "_FAST", {})
        ways.append([decoded(topic, name, data) for data in messages])
    for (one,), (other,) in zip(*ways, strict=True):
        assert isinstance(one, Measurement)
        assert same(one, other)


def test_the_short_way_is_taken() -> None:
    """Its arrays are views into the bytes of the record, and read-only."""
    data = odometry(np.random.default_rng(2))
    (made,) = decoded("/odom", ODOMETRY, data)
    assert isinstance(made, OdometryPose)
    for array in (made.pose, made.covariance, made.twist, made.twist_covariance):
        assert not array.flags.writeable
        assert np.shares_memory(array, np.frombuffer(data, np.uint8))


def test_a_buffer_that_may_change_is_copied() -> None:
    """A record is frozen even if the bytes it came in are not."""
    data = bytearray(odometry(np.random.default_rng(3)))
    (made,) = decoded("/odom", ODOMETRY, data)
    before = made.pose.copy()
    data[-680:] = bytes(680)
    assert np.array_equal(made.pose, before)
    assert not made.pose.flags.writeable


def test_big_endian_bytes_are_understood() -> None:
    """They are rare: by the long way."""
    data = odometry(np.random.default_rng(4))
    message = STORE.deserialize_cdr(data, ODOMETRY)
    (made,) = decoded("/odom", ODOMETRY, bytes(STORE.serialize_cdr(message, ODOMETRY, little_endian=False)))
    (expected,) = decoded("/odom", ODOMETRY, data)
    assert same(made, expected)


def test_every_kind_has_its_decoder() -> None:
    """One row of a cloud is one observation; a loop tells both of its moments."""
    rng = np.random.default_rng(5)
    sightings = decoded("/tags", CLOUD, landmarks(rng))
    assert [s.landmark for s in sightings if isinstance(s, LandmarkObservation)] == ["0", "1", "2", "3"]
    (relative,) = decoded("/loops", ODOMETRY, loop(rng, 5, 7))
    assert isinstance(relative, RelativePose)
    assert (relative.stamp_i, relative.stamp_j, relative.source) == (5, 7, "loops")
    (absolute,) = decoded(
        "/pose", COVARIANCE, encode_pose_with_covariance(STAMP, "map", np.ones(7), np.eye(6))
    )
    assert (absolute.stamp, absolute.source) == (STAMP, "amcl")


def test_a_topic_that_is_no_source_says_nothing() -> None:
    assert decoded("/camera", "sensor_msgs/msg/Image", b"") == ()


@pytest.mark.parametrize(
    ("topic", "name", "data", "reason", "detail"),
    [
        ("/odom", ODOMETRY, b"", "bad_message", "encapsulation"),
        ("/odom", ODOMETRY, b"\0\1\0\0", "bad_message", "Could not deserialize"),
        ("/odom", ODOMETRY, odometry(np.random.default_rng(6))[:-1], "bad_message", "Could not deserialize"),
        ("/odom", ODOMETRY, odometry(np.random.default_rng(6)) + bytes(4), "bad_message", "size mismatch"),
        (
            "/odom",
            ODOMETRY,
            odometry(np.random.default_rng(6)).replace(b"odom", b"\xff\xfe\xfd\xfc"),
            "bad_message",
            "utf-8",
        ),
        ("/loops", ODOMETRY, odometry(np.random.default_rng(6)), "bad_message", "do not say when"),
        (
            "/tags",
            CLOUD,
            encode_cloud(STAMP, "c", {"x": np.ones(1)}),
            "bad_message",
            "neither 'x' and 'y' nor",
        ),
        ("/odom", "std_msgs/msg/String", b"\0\1\0\0", "unknown_type", "kind 'odometry' has no such messages"),
    ],
)
def test_what_cannot_be_understood_is_refused_by_name(topic, name, data, reason, detail) -> None:
    """One decision that names topic, time, source and what is wrong, in one line."""
    (decision,) = decoded(topic, name, data)
    assert isinstance(decision, Decision)
    assert (decision.verdict, decision.stage, decision.reason) == ("refused", "decode", reason)
    assert (decision.stamp, decision.id, decision.source) == (9, f"{topic}@9", TABLE[topic][0])
    assert decision.detail.startswith(f"{topic} ({name}): ")
    assert detail in decision.detail
    assert "\n" not in decision.detail


def mutated(rng, data: bytes) -> bytes:
    """Some bytes changed, cut out, put in, or the end cut off."""
    bad = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        at, how = int(rng.integers(0, max(len(bad), 1))), rng.integers(0, 5)
        if how == 0:
            bad[at : at + 1] = bytes([rng.integers(0, 256)])
        elif how == 1:
            bad[at : at + 4] = int(rng.choice([0, 1, 2**16, 2**31, 2**32 - 1])).to_bytes(4, "little")
        elif how == 2:
            del bad[at:]
        elif how == 3:
            del bad[at : at + int(rng.integers(1, 9))]
        else:
            bad[at:at] = rng.bytes(int(rng.integers(1, 9)))
    return bytes(bad)


def test_no_bytes_make_the_decoder_stumble() -> None:
    """20,000 damaged messages: each is a measurement or a decision, never an exception."""
    rng = np.random.default_rng(7)
    decoder = Decoder(STORE, TABLE)
    valid = [
        ("/odom", ODOMETRY, odometry(rng)),
        ("/odom", POSE, pose(rng)),
        ("/loops", ODOMETRY, loop(rng)),
        ("/tags", CLOUD, landmarks(rng)),
        ("/pose", COVARIANCE, encode_pose_with_covariance(STAMP, "map", np.ones(7), np.eye(6))),
    ]
    refused = 0
    for n in range(20_000):
        topic, name, data = valid[n % len(valid)]
        for outcome in decoder.decode(Record(topic, name, n, mutated(rng, data))):
            assert isinstance(outcome, Measurement | Decision)
            refused += isinstance(outcome, Decision)
    assert refused > 5_000


def test_remembered_names_do_not_grow_without_end() -> None:
    """Each loop closure names two new moments."""
    rng = np.random.default_rng(8)
    decoder = Decoder(STORE, TABLE)
    for n in range(6_000):
        decoder.decode(Record("/loops", ODOMETRY, n, loop(rng, n, n + 10**9)))
    assert len(decoder._routes["/loops"].names) <= 4096
