"""The bytes that we build are those that rosbags would build."""

import time

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from slam_backend.io.encode import (
    Marker,
    Status,
    encode_cloud,
    encode_diagnostics,
    encode_markers,
    encode_odometry,
    encode_path,
    encode_pose_with_covariance,
    encode_transform,
    encode_transforms,
)

STORE = get_typestore(Stores.ROS2_JAZZY)
STAMP = 1_700_000_000_123_456_789
FRAMES = ["", "m", "ma", "map", "odom", "base_", "base_l", "base_link", "größe"]


def make(name, /, **fields):
    return STORE.types[name](**fields)


def header(stamp, frame):
    time_ = make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return make("std_msgs/msg/Header", stamp=time_, frame_id=frame)


def vector(values):
    return make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, values), strict=True)))


def pose(seven):
    point = make("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, seven[:3]), strict=True)))
    turn = make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, seven[3:]), strict=True)))
    return make("geometry_msgs/msg/Pose", position=point, orientation=turn)


def with_covariance(seven, covariance):
    return make("geometry_msgs/msg/PoseWithCovariance", pose=pose(seven), covariance=covariance)


def theirs(message):
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


@pytest.mark.parametrize("child", FRAMES)
@pytest.mark.parametrize("frame", FRAMES)
def test_odometry(frame, child) -> None:
    """Every alignment of the numbers, which the lengths of both names decide."""
    n = np.random.default_rng(1).normal(size=85)
    twist = make("geometry_msgs/msg/Twist", linear=vector(n[43:46]), angular=vector(n[46:49]))
    message = make(
        "nav_msgs/msg/Odometry",
        header=header(STAMP, frame),
        child_frame_id=child,
        pose=with_covariance(n[:7], n[7:43]),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=n[49:]),
    )
    assert encode_odometry(STAMP, frame, child, n[:7], n[7:43], n[43:49], n[49:]) == theirs(message)


@pytest.mark.parametrize("frame", FRAMES)
def test_pose_with_covariance(frame) -> None:
    n = np.random.default_rng(2).normal(size=43)
    message = make(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=header(STAMP, frame),
        pose=with_covariance(n[:7], n[7:]),
    )
    assert encode_pose_with_covariance(STAMP, frame, n[:7], n[7:].reshape(6, 6)) == theirs(message)


@pytest.mark.parametrize("child", FRAMES)
@pytest.mark.parametrize("frame", FRAMES)
def test_transform(frame, child) -> None:
    n = np.random.default_rng(3).normal(size=7)
    turn = make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, n[3:]), strict=True)))
    transform = make("geometry_msgs/msg/Transform", translation=vector(n[:3]), rotation=turn)
    message = make(
        "geometry_msgs/msg/TransformStamped",
        header=header(STAMP, frame),
        child_frame_id=child,
        transform=transform,
    )
    assert encode_transform(STAMP, frame, child, n) == theirs(message)
    alone = make("tf2_msgs/msg/TFMessage", transforms=[message])
    assert encode_transforms(STAMP, frame, {child: n}) == theirs(alone)


@pytest.mark.parametrize("count", [0, 1, 2, 5])
@pytest.mark.parametrize("frame", FRAMES)
def test_path(frame, count) -> None:
    """The first pose may be padded differently from all others."""
    rng = np.random.default_rng(4)
    stamps, sevens = STAMP + rng.integers(0, 10**12, count), rng.normal(size=(count, 7))
    poses = [
        make("geometry_msgs/msg/PoseStamped", header=header(int(s), frame), pose=pose(p))
        for s, p in zip(stamps, sevens, strict=True)
    ]
    message = make("nav_msgs/msg/Path", header=header(STAMP, frame), poses=poses)
    assert encode_path(frame, STAMP, stamps, sevens) == theirs(message)


def test_a_long_path_is_encoded_at_once() -> None:
    """10,000 poses in about a millisecond; ten are allowed on a busy machine."""
    stamps, sevens = np.arange(10_000) * 10**8, np.random.default_rng(5).normal(size=(10_000, 7))
    spent = []
    for _ in range(5):
        begin = time.process_time()
        encode_path("map", STAMP, stamps, sevens)
        spent.append(time.process_time() - begin)
    assert min(spent) < 0.01


def field(name, offset, datatype, count):
    return make("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=datatype, count=count)


@pytest.mark.parametrize("frame", FRAMES)
def test_cloud(frame) -> None:
    """Packed, dtypes kept, a matrix column becomes a field with a count."""
    rng = np.random.default_rng(6)
    columns = {
        "id": rng.integers(0, 2**32, 7, dtype=np.uint32),
        "x": rng.normal(size=7),
        "cov": rng.normal(size=(7, 9)).astype(np.float32),
        "flag": rng.integers(-128, 128, 7, dtype=np.int8),
    }
    data = b"".join(
        columns["id"][n].tobytes()
        + columns["x"][n].tobytes()
        + columns["cov"][n].tobytes()
        + columns["flag"][n].tobytes()
        for n in range(7)
    )
    message = make(
        "sensor_msgs/msg/PointCloud2",
        header=header(STAMP, frame),
        height=1,
        width=7,
        fields=[field("id", 0, 6, 1), field("x", 4, 8, 1), field("cov", 12, 7, 9), field("flag", 48, 1, 1)],
        is_bigendian=False,
        point_step=49,
        row_step=7 * 49,
        data=np.frombuffer(data, np.uint8),
        is_dense=True,
    )
    assert encode_cloud(STAMP, frame, columns) == theirs(message)


def test_a_cloud_without_points_is_a_cloud() -> None:
    """Nothing seen is a message too."""
    data = encode_cloud(STAMP, "map", {"x": np.zeros(0), "y": np.zeros(0)})
    message = STORE.deserialize_cdr(data, "sensor_msgs/msg/PointCloud2")
    assert (message.width, message.point_step, len(message.data)) == (0, 16, 0)


def test_a_cloud_refuses_what_it_cannot_say() -> None:
    """PointField has no 64-bit integers, and a table has one length."""
    with pytest.raises(ValueError, match="'id' of a cloud has the dtype int64"):
        encode_cloud(STAMP, "map", {"id": np.arange(3)})
    with pytest.raises(ValueError, match=r"different lengths: \[2, 3\]"):
        encode_cloud(STAMP, "map", {"x": np.zeros(3), "y": np.zeros(2)})


TEXTS = ["", "a", "ab", "abc", "abcd", "größe"]


@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize("count", [0, 1, 3])
def test_diagnostics(count, text) -> None:
    """Every length of name and values, in one array: levels are single bytes between strings."""
    statuses = [
        Status(n % 4, text * n, f"m{text}", text, {f"key{k}": text + "v" * k for k in range(n)})
        for n in range(count)
    ]
    message = make(
        "diagnostic_msgs/msg/DiagnosticArray",
        header=header(STAMP, ""),
        status=[
            make(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=s.level,
                name=s.name,
                message=s.message,
                hardware_id=s.hardware,
                values=[make("diagnostic_msgs/msg/KeyValue", key=k, value=v) for k, v in s.values.items()],
            )
            for s in statuses
        ],
    )
    assert encode_diagnostics(STAMP, statuses) == theirs(message)


def marker_message(frame, marker, shape):
    time_ = {"sec": 0, "nanosec": 0}
    nothing = make("std_msgs/msg/Header", stamp=make("builtin_interfaces/msg/Time", **time_), frame_id="")
    empty = np.zeros(0, np.uint8)
    return make(
        "visualization_msgs/msg/Marker",
        header=header(STAMP, frame),
        ns=marker.name,
        id=0,
        type=shape,
        action=0 if len(marker.points) else 2,
        pose=pose((0, 0, 0, 0, 0, 0, 1)),
        scale=vector((marker.size,) * 3),
        color=make("std_msgs/msg/ColorRGBA", **dict(zip("rgba", marker.color, strict=True))),
        lifetime=make("builtin_interfaces/msg/Duration", **time_),
        frame_locked=False,
        points=[pose((*p, 0, 0, 0, 1)).position for p in marker.points],
        colors=[],
        texture_resource="",
        texture=make("sensor_msgs/msg/CompressedImage", header=nothing, format="", data=empty),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=empty),
        mesh_use_embedded_materials=False,
    )


@pytest.mark.parametrize("name", TEXTS)
@pytest.mark.parametrize("frame", FRAMES)
def test_markers(frame, name) -> None:
    """Several in one array, each beginning where the last one ended; one without points deletes."""
    rng = np.random.default_rng(7)
    shapes = {"strip": 4, "lines": 5, "spheres": 7, "points": 8}
    markers = [
        Marker(name * n, shape, rng.normal(size=(2 * n, 3)), 0.1 * n, (0.25, 0.5, 1.0, 1.0))
        for n, shape in enumerate(shapes)
    ]
    message = make(
        "visualization_msgs/msg/MarkerArray",
        markers=[marker_message(frame, marker, shapes[marker.shape]) for marker in markers],
    )
    assert encode_markers(STAMP, frame, markers) == theirs(message)


def test_a_marker_array_without_markers() -> None:
    """Nothing to draw is a message too."""
    assert encode_markers(STAMP, "map", []) == theirs(make("visualization_msgs/msg/MarkerArray", markers=[]))


def test_a_wrong_number_of_numbers_is_refused() -> None:
    """Six numbers are no pose."""
    with pytest.raises(ValueError, match="reshape"):
        encode_pose_with_covariance(STAMP, "map", np.zeros(6), np.zeros(36))
