"""Whatever bytes come on whatever topic: nothing raises, nothing hangs, and what was refused has left no trace.

Messages of every kind and type are spoilt (bits, lengths, stamps, NaN, huge and tiny numbers, swapped fields) and sent between
sound ones, from bytes to the estimate.
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from time import process_time
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam_backend.core.backend import Backend
from slam_backend.core.config import Config, config_from
from slam_backend.core.decisions import DecisionLog
from slam_backend.core.graph import Decision
from slam_backend.core.measurement import SECOND, format_stamp
from slam_backend.core.sensors import SENSORS
from slam_backend.io.cdr import Decoder
from slam_backend.io.encode import (
    encode_cloud,
    encode_odometry,
    encode_pose_with_covariance,
    encode_transforms,
)
from slam_backend.io.records import Record
from slam_backend.io.replay import settled_stream
from slam_backend.io.typestore import typestore_of

STORE = typestore_of(())
Rng = np.random.Generator
NOISE = np.diag([0.01, 0.01, 0.02, 0.001, 0.001, 0.002])
BEGIN, STEP = 1000 * SECOND, SECOND // 5
KEYFRAMES = 40
AFAR = 1_000_000
FOCAL, CENTRE = 300.0, 320.0  # pixels
MOST, HALF = 0.8, 0.5  # of the sound keyframes survive; nothing tells how far a relative pose may reach


class Input(NamedTuple):
    """make: number of the message and stamp (ns) -> CDR."""

    kind: str
    type: str
    make: Callable[[int, int], bytes]


def pose(n: int) -> tuple[float, ...]:
    """A circle with a little height, half a metre a step; from AFAR on another one, a kilometre away."""
    angle = n / 20
    return (
        10 * np.cos(angle) + 1000 * (n >= AFAR),
        10 * np.sin(angle),
        0.1 * np.sin(n),
        0.0,
        0.0,
        np.sin(angle / 2),
        np.cos(angle / 2),
    )


def odometry(n: int, stamp: int) -> bytes:
    return encode_odometry(stamp, "odom", "base", pose(n), NOISE, np.zeros(6), NOISE)


def pose_with_covariance(n: int, stamp: int) -> bytes:
    return encode_pose_with_covariance(stamp, "map", pose(n), NOISE)


def pose_alone(n: int, stamp: int) -> bytes:
    return pose_with_covariance(n, stamp)[: -36 * 8]


def transforms(n: int, stamp: int) -> bytes:
    return encode_transforms(stamp, "odom", {"base": pose(n), "other": pose(n + 1)})


def mounts(n: int, stamp: int) -> bytes:
    return encode_transforms(
        stamp, "base", {"camera": (0.1, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0), f"lidar{n % 3}": pose(n)}
    )


def relative(n: int, stamp: int) -> bytes:
    """What lies five steps back, seen from there; one step where such edges drive."""
    before = format_stamp(stamp - STEP * (5 if n % 2 else 1))
    step = (
        (2.0, 0.5, 0.0, 0.0, 0.0, np.sin(0.125), np.cos(0.125))
        if n % 2
        else (0.5, 0.0, 0.0, 0.0, 0.0, 0.025, 0.9997)
    )
    return encode_odometry(
        stamp, f"base@{before}", f"base@{format_stamp(stamp)}", step, NOISE, np.zeros(6), np.zeros((6, 6))
    )  # fmt: skip


def relatives(n: int, stamp: int) -> bytes:
    a, b = (np.array([stamp - STEP * k for k in (n % 7 + 1, n % 5 + 6)]), np.array([stamp, stamp - STEP]))
    sevens = np.tile([0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (2, 1))
    times = {f"stamp_{e}_{p}": v.astype(np.uint32) for e, t in (("i", a), ("j", b)) for p, v in zip(("sec", "nsec"), divmod(t, SECOND), strict=True)}  # fmt: skip
    columns = {name: sevens[:, k] for k, name in enumerate(("x", "y", "z", "qx", "qy", "qz", "qw"))}
    return encode_cloud(stamp, "base", {**times, **columns, "cov": np.tile(NOISE.ravel(), (2, 1))})


def points(n: int, stamp: int) -> bytes:
    forms = (("x", "y", "z"), ("range", "azimuth", "elevation"), ("azimuth", "elevation"))
    names = forms[n % 3]
    ids = np.array([n % 4, n % 5], np.uint32) if n % 2 else np.array([n % 4, n % 5], np.float64)
    return encode_cloud(
        stamp, "camera" if n % 4 else "base",
        {"id": ids, **{name: np.array([1.5, 2.5]) + k / 10 for k, name in enumerate(names)}, "sigma": np.full(2, 0.1)},
    )  # fmt: skip


def header(stamp: int, frame: str) -> Any:
    time = STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp, SECOND))
    return STORE.types["std_msgs/msg/Header"](time, frame)


def echo(n: int, stamp: int) -> bytes:
    x, y, *_ = pose(n)
    measured = float(np.hypot(x - 5.0 * (n % 3), y - 4.0))
    message = STORE.types["sensor_msgs/msg/Range"](
        header(stamp, f"beacon{n % 3}"), 0, 0.1, 0.1, 100.0, measured, 0.01
    )
    return bytes(STORE.serialize_cdr(message, "sensor_msgs/msg/Range"))


def fix(n: int, stamp: int) -> bytes:
    x, y, z, *_ = pose(n)
    status = STORE.types["sensor_msgs/msg/NavSatStatus"](0, 1)
    place = 48.0 + y / 111_200, 11.0 + x / 74_500, 500.0 + z
    message = STORE.types["sensor_msgs/msg/NavSatFix"](
        header(stamp, "antenna"), status, *place, np.eye(3).ravel(), 2
    )
    return bytes(STORE.serialize_cdr(message, "sensor_msgs/msg/NavSatFix"))


def inertial(n: int, stamp: int) -> bytes:
    vector, turn = STORE.types["geometry_msgs/msg/Vector3"], STORE.types["geometry_msgs/msg/Quaternion"]
    noise = (np.eye(3) * 1e-4).ravel()
    message = STORE.types["sensor_msgs/msg/Imu"](
        header(stamp, "imu"), turn(0.0, 0.0, 0.0, 1.0), noise,
        vector(0.0, 0.0, 0.25), noise, vector(0.01 * (n % 3), 0.625, 9.81), noise,
    )  # fmt: skip
    return bytes(STORE.serialize_cdr(message, "sensor_msgs/msg/Imu"))


def features(n: int, stamp: int) -> bytes:
    """Lamps above the robot, seen by a camera that looks up."""
    x, y, z, _, _, s, c = pose(n)
    turn = np.array([[c * c - s * s, 2 * s * c], [-2 * s * c, c * c - s * s]])
    lamps = np.array([(4.0 * i, 4.0 * j) for i in range(-4, 5) for j in range(-4, 5)])
    seen = (lamps - (x, y)) @ turn.T - (0.1, 0.0)
    u, v = (FOCAL * seen / (8.0 - z) + CENTRE).T
    ids = np.flatnonzero((np.abs(u - CENTRE) < CENTRE) & (np.abs(v - CENTRE) < CENTRE))
    return encode_cloud(stamp, "camera", {"id": ids.astype(np.int32), "u": u[ids], "v": v[ids]})


def tag(n: int, stamp: int) -> bytes:
    child = f"tag36h11:{n % 3}"
    return encode_odometry(
        stamp, "camera", child, (1.5, 0.2, 3.0, 0.0, 0.0, 0.0, 1.0), NOISE, np.zeros(6), NOISE
    )


def lens(n: int, stamp: int) -> bytes:
    k = np.array([FOCAL + n % 2, 0, CENTRE, 0, FOCAL, CENTRE, 0, 0, 1.0])
    p = np.insert(k, (3, 6, 9), 0.0)
    region = STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    message = STORE.types["sensor_msgs/msg/CameraInfo"](
        header(stamp, "camera"), 640, 640, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, region
    )
    return bytes(STORE.serialize_cdr(message, "sensor_msgs/msg/CameraInfo"))


INPUTS = {
    "wheels": Input("odometry", "nav_msgs/msg/Odometry", odometry),
    "visual": Input("odometry", "geometry_msgs/msg/PoseWithCovarianceStamped", pose_with_covariance),
    "tracker": Input("odometry", "geometry_msgs/msg/PoseStamped", pose_alone),
    "transforms": Input("odometry", "tf2_msgs/msg/TFMessage", transforms),
    "loops": Input("relative", "nav_msgs/msg/Odometry", relative),
    "batches": Input("relative", "sensor_msgs/msg/PointCloud2", relatives),
    "trees": Input("landmark", "sensor_msgs/msg/PointCloud2", points),
    "fixes": Input("pose", "geometry_msgs/msg/PoseWithCovarianceStamped", pose_with_covariance),
    "beacons": Input("landmark", "sensor_msgs/msg/Range", echo),
    "satellites": Input("gnss", "sensor_msgs/msg/NavSatFix", fix),
    "rates": Input("imu", "sensor_msgs/msg/Imu", inertial),
    "tags": Input("landmark", "nav_msgs/msg/Odometry", tag),
    "images": Input("pixels", "sensor_msgs/msg/PointCloud2", features),
    "lens": Input("pixels", "sensor_msgs/msg/CameraInfo", lens),
    "/tf_static": Input("static", "tf2_msgs/msg/TFMessage", mounts),
}
OBSERVING = (
    "loops", "batches", "trees", "fixes", "beacons", "satellites", "rates", "tags", "images", "lens",
    "/tf_static",
)  # fmt: skip
SOLID = ("rates", "images", "lens")  # need 3-D
SPECIAL = [
    np.nan,
    np.inf,
    -np.inf,
    0.0,
    -1.0,
    1e308,
    -1e308,
    1e12,
    1e100,
    4e-323,
    1e-18,
    1e-300,
    1e9,
    1e10,
    0.5,
]
STAMPS = [0, 1, -1, (1 << 31) - 1, 1 << 20, -(1 << 31)]


def test_every_input_that_there_is_has_a_maker() -> None:
    assert {(i.kind, i.type) for i in INPUTS.values()} == {
        (k, t) for k, s in SENSORS.items() for t in s.decoders
    }


@pytest.mark.parametrize("name", INPUTS)
def test_the_makers_make_what_the_decoder_takes(name: str) -> None:
    made = decoded([Record(name, INPUTS[name].type, 0, INPUTS[name].make(n, 100 * SECOND)) for n in range(6)])
    assert made
    assert not any(isinstance(item, Decision) for _, item in made)


# -- spoiling ------------------------------------------------------------------------------------------------------


def flip(data: bytearray, rng: Rng) -> bytearray:
    for at in rng.integers(0, len(data) * 8, rng.integers(1, 6)).tolist():
        data[at // 8] ^= 1 << at % 8
    return data


def cut(data: bytearray, rng: Rng) -> bytearray:
    return data[: int(rng.integers(0, len(data)))]


def lengthen(data: bytearray, rng: Rng) -> bytearray:
    return data + rng.bytes(int(rng.integers(1, 64)))


def special(data: bytearray, rng: Rng) -> bytearray:
    """A number that no sensor says, where a float64 may lie."""
    for _ in range(int(rng.integers(1, 4))):
        at = 4 + 4 * int(rng.integers(0, max((len(data) - 12) // 4, 1)))
        if at + 8 <= len(data):
            struct.pack_into("<d", data, at, SPECIAL[int(rng.integers(len(SPECIAL)))])
    return data


def swap(data: bytearray, rng: Rng) -> bytearray:
    """Two stretches change places."""
    size = int(rng.choice([4, 8, 24, 56]))
    a, b = sorted(4 + 4 * rng.integers(0, max((len(data) - size) // 4, 1), 2))
    data[a : a + size], data[b : b + size] = data[b : b + size], data[a : a + size]
    return data


def misdate(data: bytearray, rng: Rng) -> bytearray:
    sec, nsec = struct.unpack_from("<iI", data, 4)
    near = min(max(sec + int(rng.integers(-20, 20)), -(1 << 31)), (1 << 31) - 1)
    chosen = near if rng.random() < 0.5 else STAMPS[int(rng.integers(len(STAMPS)))]
    struct.pack_into("<iI", data, 4, chosen, nsec if rng.random() < 0.7 else int(rng.integers(0, 1 << 32)))
    return data


def count_wrong(data: bytearray, rng: Rng) -> bytearray:
    """A length or a count that is absurd."""
    at = 4 * int(rng.integers(1, len(data) // 4))
    struct.pack_into("<I", data, at, int(rng.choice([0, 1, 255, 1 << 16, 1 << 28, (1 << 32) - 1])))
    return data


SPOILERS = (flip, cut, lengthen, special, special, swap, misdate, misdate, count_wrong)


def spoilt(data: bytes, rng: Rng) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 3))):
        if len(changed) > 16:
            changed = SPOILERS[int(rng.integers(len(SPOILERS)))](changed, rng)
    return bytes(changed)


# -- worlds --------------------------------------------------------------------------------------------------------


def world(driver: str, space: str, noise: str, seed: int, bad: int) -> tuple[Config, list[Record]]:
    """A sound drive, its first steps undisturbed, with one observation of each kind every fourth step, which comes one step after
    its moment; and `bad` spoilt messages of all sources among them. Now and then the driving odometry is wrong about where the
    robot is, and about when.
    """
    rng = np.random.default_rng(seed)
    unfit = SOLID if space == "2d" else ("rates",) if driver == "loops" else ()  # an IMU would drive
    names = [driver, *(name for name in OBSERVING if name not in (driver, *unfit))]
    sources = {name: {"kind": INPUTS[name].kind, "topic": name} for name in names if name != "/tf_static"}
    sources[driver] |= {"noise": noise, "max_speed": 5.0} if INPUTS[driver].kind == "odometry" else {}
    if "images" in sources:
        sources["images"]["camera"] = {"fx": FOCAL, "fy": FOCAL, "cx": CENTRE, "cy": CENTRE}
    config = config_from(
        {"space": space, "keyframes": {"distance": 0.4}, "sources": list(sources), **sources}
    )
    records: list[Record] = []
    share = bad / KEYFRAMES
    for n in range(KEYFRAMES):
        stamp = BEGIN + n * STEP
        own = 2 * n if driver == "loops" else n  # an even one spans a single step
        records.append(Record(driver, INPUTS[driver].type, stamp, INPUTS[driver].make(own, stamp)))
        records += [
            Record(name, INPUTS[name].type, stamp, INPUTS[name].make(n - 1, stamp - STEP))
            for name in names[1:]
            if n % 4 == 2
        ]
        for _ in range(int(share) + (rng.random() < share % 1) if n > 2 else 0):
            name = names[int(rng.integers(0, len(names)))]
            data = spoilt(
                INPUTS[name].make(int(rng.integers(0, 100)), stamp + int(rng.integers(0, STEP))), rng
            )
            records.append(Record(name, INPUTS[name].type, stamp, data))
        if n % 4 == 3 and INPUTS[driver].kind == "odometry":
            data = INPUTS[driver].make(AFAR + n, stamp + int(rng.integers(STEP, SECOND)))
            records.append(Record(driver, INPUTS[driver].type, stamp, data))
    return config, records


def decoded(records: Sequence[Record]) -> list[tuple[int, object]]:
    """Number of the record and what it says."""
    decoder = Decoder(STORE, {name: (name, each.kind) for name, each in INPUTS.items()})
    return [(n, item) for n, record in enumerate(records) for item in decoder.decode(record)]


def solved(config: Config, records: Sequence[Record]) -> tuple[Backend, DecisionLog, set[tuple[str, int]]]:
    """From bytes to the estimate; with the sources and stamps of what the firewall let through."""
    backend, log, kept = Backend(config), DecisionLog(), set()

    def told(updates) -> None:
        for update in updates:
            log.extend(update.decisions)

    for item in settled_stream((item for _, item in decoded(records)), config):
        if isinstance(item, Decision):
            log.add(item)
        else:
            kept.add((item.source, item.stamp))
            told(backend.add(item))
    told(backend.finish())
    return backend, log, kept


def worlds() -> Iterator[tuple[str, str, str]]:
    for driver in ("wheels", "visual", "tracker", "transforms", "loops"):
        for space in ("2d", "3d"):
            for noise in ("model", "twist", "pose") if driver == "wheels" else ("model",):
                yield driver, space, noise


WORLDS = list(worlds())


def prove(driver: str, space: str, noise: str, seed: int, bad: int) -> int:
    """Factors and estimate are those of the same input without what was refused; they are finite, and most of the sound
    keyframes are there. Returns the number refused.

    It holds while what the driving source says wrong is refused or believed for good when it comes. A message that fits what was
    known then, and is contradicted later by one of between, has moved the watermark.
    """
    config, records = world(driver, space, noise, seed, bad)
    backend, log, kept = solved(config, records)
    sound = {
        n
        for n, item in decoded(records)
        if not isinstance(item, Decision) and (item.source, item.stamp) in kept
    }
    again, _, _ = solved(config, [record for n, record in enumerate(records) if n in sound])
    first, second = backend.snapshot(), again.snapshot()
    np.testing.assert_array_equal(first.stamps, second.stamps)
    assert list(backend.solver.factors) == list(again.solver.factors)
    np.testing.assert_allclose(first.trajectory.sevens, second.trajectory.sevens, atol=1e-6, rtol=1e-6)
    assert np.isfinite(first.trajectory.sevens).all()
    survive = {BEGIN + n * STEP for n in range(KEYFRAMES)} & set(first.stamps.tolist())
    assert len(survive) >= (MOST if INPUTS[driver].kind == "odometry" else HALF) * KEYFRAMES
    assert all(decision.reason for decision in log)
    assert len(log) < 10 * len(records)
    return len(records) - len(sound)


@pytest.mark.parametrize(("driver", "space", "noise"), WORLDS)
def test_what_is_refused_leaves_no_trace(driver: str, space: str, noise: str) -> None:
    assert prove(driver, space, noise, seed=1, bad=130) > 30


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
def test_a_hundred_thousand_spoilt_messages(part: int) -> None:
    begin = process_time()
    for seed in range(40):
        driver, space, noise = WORLDS[(part + seed) % len(WORLDS)]
        prove(driver, space, noise, seed=1000 * part + seed, bad=250)
    assert process_time() - begin < 1200


@given(
    which=st.sampled_from(sorted(INPUTS)),
    seed=st.integers(0, 2**32 - 1),
    garbage=st.one_of(st.none(), st.binary(max_size=400)),
)
@settings(max_examples=200, deadline=None)
def test_any_bytes_become_measurements_or_one_decision(which: str, seed: int, garbage: bytes | None) -> None:
    rng = np.random.default_rng(seed)
    data = (
        spoilt(INPUTS[which].make(seed % 50, 50 * SECOND), rng) if garbage is None else b"\0\1\0\0" + garbage
    )
    made = [item for _, item in decoded([Record(which, INPUTS[which].type, 5, data)])]
    refused = [item for item in made if isinstance(item, Decision)]
    assert not refused or len(made) == 1
