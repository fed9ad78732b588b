"""Bags of every kind give the same records in the same order; damaged ones give what is readable, and say so."""

import shutil
import sqlite3
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from slam_backend.core.errors import BadFile
from slam_backend.io.bags import Topic, open_bag, write_bag
from slam_backend.io.encode import encode_odometry, encode_pose_with_covariance
from slam_backend.io.records import Record

DATA = Path(__file__).parents[2] / "../shared/data/bags"
ODOMETRY, COVARIANCE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped"
START = 1_700_000_000_000_000_000


def recording(count: int, seed: int = 0, *, ties: bool = True) -> list[Record]:
    """Odometry and a localizer, in the order that bags are read in; with ties half of the log times are equal."""
    rng = np.random.default_rng(seed)
    records = []
    for n in range(count):
        a = rng.normal(size=85)
        time = START + (n // 4 * 4 if ties else n) * 10**7
        if n % 4 == 3:
            records.append(
                Record("/amcl", COVARIANCE, time, encode_pose_with_covariance(n, "map", a[:7], a[7:43]))
            )
        else:
            data = encode_odometry(n, "odom", "base", a[:7], a[7:43], a[43:49], a[49:])
            records.append(Record("/odom", ODOMETRY, time, data))
    return sorted(records, key=lambda r: (r.log_time, r.topic))  # stable: position within topic stays


def write_rosbag1(path: Path, records: list[Record], compression: str = "none", chunk: int = 1 << 15) -> Path:
    ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
    writer = Rosbag1Writer(path)
    writer.chunk_threshold = chunk
    if compression != "none":
        writer.set_compression(Rosbag1Writer.CompressionFormat[compression.upper()])
    with writer:
        connections = {}
        for r in records:
            if r.topic not in connections:
                connections[r.topic] = writer.add_connection(r.topic, r.type, typestore=ros1)
            writer.write(connections[r.topic], r.log_time, ros2.cdr_to_ros1(r.data, r.type))
    return path


def written(kind: str, folder: Path, records: list[Record]) -> Path:
    """A bag of that kind; the file itself, also of sqlite3."""
    if kind.startswith("rosbag1"):
        return write_rosbag1(folder / "one.bag", records, kind.partition("-")[2] or "none")
    if kind == "mcap":
        write_bag(folder / "one.mcap", records, chunk_bytes=1 << 15)
        return folder / "one.mcap"
    write_bag(folder / "one", records)
    return folder / "one" / "one.db3"


def flat(records) -> list[tuple[int, str, str, bytes]]:
    return [(r.log_time, r.topic, r.type, bytes(r.data)) for r in records]


def read(path: Path, topics=None) -> tuple[list[tuple[int, str, str, bytes]], list[str]]:
    with open_bag(path) as bag:
        return flat(bag.records(topics)), bag.damage


def attempt(path: Path) -> tuple[list[tuple[int, str, str, bytes]], list[str]]:
    """Records and damage; a BadFile is no record and one line."""
    try:
        return read(path)
    except BadFile as bad:
        return [], [str(bad)]


KINDS = ["rosbag1", "rosbag1-bz2", "rosbag1-lz4", "mcap", "sqlite3"]


@pytest.mark.parametrize("kind", KINDS)
def test_every_storage_gives_the_same_records(kind, tmp_path) -> None:
    """Types, bytes and order, although half of the log times are equal."""
    records = recording(1_000)
    path = written(kind, tmp_path, records)
    assert read(path) == (flat(records), [])
    with open_bag(path) as bag:
        assert bag.topics == {"/amcl": Topic(COVARIANCE, 250), "/odom": Topic(ODOMETRY, 750)}
        assert bag.count == 1_000


@pytest.mark.parametrize("kind", KINDS)
def test_the_order_does_not_depend_on_the_order_in_the_file(kind, tmp_path) -> None:
    """Recorders write late messages late: across chunks, log time decides, then topic, then position."""
    records = recording(1_000)
    late = list(np.random.default_rng(1).permutation(1_000))
    path = written(kind, tmp_path, [records[n] for n in late])
    position = {n: p for p, n in enumerate(late)}
    expected = sorted(range(1_000), key=lambda n: (records[n].log_time, records[n].topic, position[n]))
    assert read(path) == (flat(records[n] for n in expected), [])


@pytest.mark.parametrize("kind", KINDS)
def test_topics_can_be_chosen(kind, tmp_path) -> None:
    """And a name that is not there yields nothing."""
    records = recording(200)
    path = written(kind, tmp_path, records)
    assert read(path, {"/amcl", "/absent"})[0] == flat(r for r in records if r.topic == "/amcl")
    assert read(path, [])[0] == []


def test_a_bag_is_read_as_often_as_one_likes(tmp_path) -> None:
    """Two readers at a time do not disturb one another."""
    records = recording(600)
    for kind in ("rosbag1", "mcap", "sqlite3"):
        with open_bag(written(kind, tmp_path, records)) as bag:
            pairs = list(zip(bag.records(), bag.records(), strict=True))
        assert flat(a for a, _ in pairs) == flat(b for _, b in pairs) == flat(records)


def test_a_copy_in_another_storage_is_equal(tmp_path) -> None:
    """mcap to sqlite3 and back: the same records."""
    records = recording(500)
    write_bag(tmp_path / "a.mcap", records)
    with open_bag(tmp_path / "a.mcap") as bag:
        assert write_bag(tmp_path / "b", bag.records(), bag.typestore) == 500
    with open_bag(tmp_path / "b") as bag:
        write_bag(tmp_path / "c.mcap", bag.records(), bag.typestore)
    assert read(tmp_path / "b") == read(tmp_path / "c.mcap") == (flat(records), [])
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "c.mcap").read_bytes()


@pytest.mark.parametrize("name", ["bag.mcap", "bag"])
def test_equal_records_make_equal_bytes(name, tmp_path) -> None:
    for place in ("one", "other"):
        write_bag(tmp_path / place / name, recording(300))
    one, other = (
        {p.name: p.read_bytes() for p in (tmp_path / place).rglob("*") if p.is_file()}
        for place in ("one", "other")
    )
    assert one == other


def test_log_times_can_be_made_strictly_increasing(tmp_path) -> None:
    """For readers that know no order among equals."""
    records = recording(100)
    write_bag(tmp_path / "bag.mcap", records, strictly_increasing=True)
    got, _ = read(tmp_path / "bag.mcap")
    assert [row[3] for row in got] == [r.data for r in records]
    assert all(a[0] < b[0] for a, b in pairwise(got))


def test_a_writer_never_overwrites_and_leaves_nothing_half_done(tmp_path) -> None:
    write_bag(tmp_path / "bag.mcap", recording(3))
    with pytest.raises(BadFile, match=r"bag\.mcap: exists already"):
        write_bag(tmp_path / "bag.mcap", recording(3))
    with pytest.raises(BadFile, match=r"cannot write '\.bag'"):
        write_bag(tmp_path / "other.bag", recording(3))
    for name in ("unknown.mcap", "unknown"):
        with pytest.raises(BadFile, match="a message type is not defined"):
            write_bag(tmp_path / name, [Record("/x", "no_such/msg/Type", 1, b"\0\1\0\0")])

    def breaks_off():
        yield from recording(10)
        raise InterruptedError("no more")

    with pytest.raises(BadFile, match="no more"):
        write_bag(tmp_path / "half.mcap", breaks_off())
    assert [p.name for p in tmp_path.iterdir()] == ["bag.mcap"]


def test_types_that_the_bag_defines_are_known(tmp_path) -> None:
    """Also those that Jazzy knows otherwise; and they survive a copy."""
    store = get_typestore(Stores.ROS2_JAZZY)
    own = get_types_from_msg("float64 depth\nstring place\ngeometry_msgs/Point at\n", "dive_msgs/msg/Depth")
    store.register(own)
    point = store.types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0)
    message = store.types["dive_msgs/msg/Depth"](depth=12.5, place="reef", at=point)
    record = Record(
        "/depth", "dive_msgs/msg/Depth", 5, bytes(store.serialize_cdr(message, "dive_msgs/msg/Depth"))
    )
    write_bag(tmp_path / "a.mcap", [record], store)
    with open_bag(tmp_path / "a.mcap") as bag:
        write_bag(tmp_path / "b", bag.records(), bag.typestore)
    with open_bag(tmp_path / "b") as bag:
        (got,) = bag.records()
        depth = bag.typestore.deserialize_cdr(got.data, got.type)
    assert (depth.depth, depth.place, depth.at.z) == (12.5, "reef", 3.0)


def write_split(folder: Path, records: list[Record], files: int) -> None:
    """What `ros2 bag record --max-bag-size` leaves when it dies: files, no metadata.yaml."""
    folder.mkdir()
    size = len(records) // files
    for n in range(files):
        write_bag(folder / f"run_{n}.mcap", records[n * size : (n + 1) * size])


def test_a_folder_of_several_files_is_one_bag(tmp_path) -> None:
    """Eleven files without metadata.yaml; run_10 comes after run_9."""
    records = recording(1_100)
    write_split(tmp_path / "run", records, 11)
    assert read(tmp_path / "run") == (flat(records), [])


def test_metadata_says_which_files_belong(tmp_path) -> None:
    """What is missing, or lies there unnamed, is said."""
    records = recording(400)
    write_split(tmp_path / "run", records, 4)
    names = "\n".join(f"  - run_{n}.mcap" for n in (0, 1, 2, 7))
    metadata = tmp_path / "run" / "metadata.yaml"
    metadata.write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}\n")
    got, damage = read(tmp_path / "run")
    assert got == flat(records[:300])
    assert any("run_7.mcap: is named in metadata.yaml but missing" in line for line in damage)
    assert any("run_3.mcap: is not named in metadata.yaml" in line for line in damage)
    metadata.write_text("rosbag2_bagfile_information: [")
    got, damage = read(tmp_path / "run")
    assert got == flat(records)
    assert any("metadata.yaml: cannot be understood" in line for line in damage)


def test_one_unreadable_file_does_not_take_the_others_with_it(tmp_path) -> None:
    records = recording(400)
    write_split(tmp_path / "run", records, 4)
    (tmp_path / "run" / "run_1.mcap").write_bytes(b"")
    got, damage = read(tmp_path / "run")
    assert got == flat(records[:100] + records[200:])
    assert any("run_1.mcap: the file is empty" in line for line in damage)


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE, CompressionMode.STORAGE])
@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_compressed_bags_are_read(mode, plugin, tmp_path) -> None:
    """File by file, message by message, or by the storage itself."""
    if mode == CompressionMode.STORAGE and plugin == StoragePlugin.SQLITE3:
        pytest.skip("sqlite3 has none")
    records = recording(200)
    writer = FolderWriter(tmp_path / "bag", version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    store = get_typestore(Stores.ROS2_JAZZY)
    with writer:
        connections = {
            t: writer.add_connection(*t, typestore=store) for t in {(r.topic, r.type) for r in records}
        }
        for r in records:
            writer.write(connections[r.topic, r.type], r.log_time, r.data)
    assert read(tmp_path / "bag") == (flat(records), [])


def test_a_cut_compressed_file_gives_what_comes_before(tmp_path) -> None:
    records = recording(2_000, ties=False)
    write_bag(tmp_path / "bag.mcap", records, chunk_bytes=1 << 16)
    packed = zstandard.compress((tmp_path / "bag.mcap").read_bytes())
    (tmp_path / "bag.mcap.zstd").write_bytes(packed[: len(packed) // 2])
    got, damage = read(tmp_path / "bag.mcap.zstd")
    assert 0 < len(got) < 2_000
    assert got == flat(records)[: len(got)]
    assert any("the compressed file is cut off" in line for line in damage)


@pytest.mark.parametrize(
    "settings", [{"index_types": IndexType.NONE}, {"use_chunking": False}, {"use_statistics": False}]
)
@pytest.mark.parametrize("compression", list(CompressionType))
def test_mcap_without_index_or_chunks_is_read_whole(settings, compression, tmp_path) -> None:
    """Other writers leave out what they need not write; that is no damage."""
    records = recording(3_000)
    with (tmp_path / "bag.mcap").open("wb") as file:
        writer = McapWriter(file, compression=compression, chunk_size=1 << 16, **settings)
        writer.start(profile="ros2", library="test")
        channels = {}
        for r in records:
            if r.topic not in channels:
                schema = writer.register_schema(r.type, "ros2msg", b"")
                channels[r.topic] = writer.register_channel(r.topic, "cdr", schema)
            writer.add_message(channels[r.topic], r.log_time, r.data, r.log_time)
        writer.finish()
    assert read(tmp_path / "bag.mcap") == (flat(records), [])


def test_messages_that_are_not_of_ros_are_said_to_be_left_out(tmp_path) -> None:
    with (tmp_path / "bag.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="", library="test")
        channel = writer.register_channel(
            "/json", "json", writer.register_schema("thing", "jsonschema", b"{}")
        )
        writer.add_message(channel, 5, b"{}", 5)
        writer.finish()
    got, damage = read(tmp_path / "bag.mcap")
    assert got == []
    assert "1 messages of /json left out: the encoding 'json'" in damage[0]


def test_a_database_in_use_is_read_with_its_log(tmp_path) -> None:
    """A recorder that still runs, or was killed, leaves the newest messages in the -wal file."""
    records = recording(100)
    path = written("sqlite3", tmp_path, records)
    recorder = sqlite3.connect(path)
    recorder.execute("PRAGMA journal_mode=WAL")
    recorder.execute("PRAGMA wal_autocheckpoint=0")
    newest = records[-1].log_time + 1
    recorder.execute(
        "INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, ?, data FROM messages WHERE id = 1",
        (newest,),
    )
    recorder.commit()
    killed = tmp_path / "killed"
    killed.mkdir()
    for file in path.parent.glob("*.db3*"):
        if not file.name.endswith("-shm"):
            shutil.copy(file, killed)
    for place in (path, killed):
        got, damage = read(place)
        assert damage == []
        assert got[:-1] == flat(records)
        assert got[-1][0] == newest
    recorder.close()


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("empty.mcap", b"", "the file is empty"),
        ("empty.bag", b"", "the file is empty"),
        ("picture.db3", b"\x89PNG\r\n\x1a\n" + bytes(5000), "neither a rosbag1, an mcap nor a sqlite3 file"),
        ("old.bag", b"#ROSBAG V1.2\n" + bytes(5000), "not format 2.0"),
        ("head.bag", b"#ROSBAG V2.0\n\x10\0\0", "ends within its header"),
        ("head.mcap", b"\x89MCAP0\r\n\x01", "ends before its first message"),
        ("zeros.mcap", b"\x89MCAP0\r\n" + bytes(5000), "ends before its first message"),
        ("other.db3", None, "not a readable rosbag2 database: no such table"),
        ("zeros.db3", b"SQLite format 3\0" + bytes(5000), "not a readable rosbag2 database"),
    ],
)
def test_what_is_no_bag_is_named_in_one_line(name, content, says, tmp_path) -> None:
    path = tmp_path / name
    if content is None:
        with sqlite3.connect(path) as database:
            database.execute("CREATE TABLE cookies (id)")
        database.close()
    else:
        path.write_bytes(content)
    with pytest.raises(BadFile) as caught:
        open_bag(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_not_there_is_named_in_one_line(tmp_path) -> None:
    with pytest.raises(BadFile, match="no such file or folder"):
        open_bag(tmp_path / "absent.bag")
    with pytest.raises(BadFile, match=r"no \.mcap or \.db3 file in this folder"):
        open_bag(tmp_path)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_cut_at_any_byte_gives_what_comes_before_and_says_so(kind, tmp_path) -> None:
    """At 100 random bytes: the first records of the whole, and a line of damage or a BadFile."""
    records = recording(600, ties=False)
    path = written(kind, tmp_path, records)
    whole, data = flat(records), path.read_bytes()
    cut = tmp_path / f"cut{path.suffix}"
    counts = []
    for at in np.sort(np.random.default_rng(2).integers(0, len(data), 100)):
        cut.write_bytes(data[:at])
        got, damage = attempt(cut)
        assert damage
        assert all(line.startswith(f"{cut}: ") for line in damage)
        assert got == whole[: len(got)]
        counts.append(len(got))
    assert counts == sorted(counts)  # the more of the file, the more is read
    share = np.array(counts) / len(whole)
    assert share[50] > 0.3  # half of the file: nearly half of the messages
    assert share[-1] > 0.8


def test_a_cut_database_is_read_to_the_last_row_on_a_whole_page(tmp_path) -> None:
    records = recording(300, ties=False)
    path, page = written("sqlite3", tmp_path, records), 4096
    whole, data, cut = flat(records), path.read_bytes(), tmp_path / "cut.db3"
    ends = np.array([data.index(record.data) + len(record.data) for record in records])
    left_out = []
    for at in range(len(data) // 4, len(data) // 2, page):
        cut.write_bytes(data[: at + 100])
        got, _ = attempt(cut)
        assert got == whole[: len(got)]
        left_out.append(int((ends <= (at + 100) // page * page).sum()) - len(got))
    assert max(left_out) == 0


@pytest.mark.parametrize("kind", KINDS)
def test_no_changed_byte_makes_the_reader_stumble(kind, tmp_path) -> None:
    """100 bags with some bytes overwritten: records that were there or a clear line, never another exception."""
    records = recording(200, ties=False)
    path = written(kind, tmp_path, records)
    data, known = path.read_bytes(), Counter(flat(records))
    rng = np.random.default_rng(3)
    bad = tmp_path / f"bad{path.suffix}"
    for _ in range(100):
        changed = bytearray(data)
        for _ in range(rng.integers(1, 6)):
            at = int(rng.integers(0, len(data)))
            changed[at : at + int(rng.integers(1, 9))] = rng.bytes(int(rng.integers(1, 9)))
        bad.write_bytes(changed)
        got, damage = attempt(bad)
        assert all("\n" not in line for line in damage)
        assert len(got) <= len(records) + 1
        if kind == "mcap":  # its checksums see every change
            assert not Counter(got) - known
            assert damage or len(got) == len(records)


def all_bags() -> list[Path]:
    if not DATA.exists():
        return []
    files = [p for p in DATA.rglob("*") if p.suffix in {".bag", ".db3", ".mcap"}]
    return sorted({*files, *(p for p in DATA.rglob("*") if p.is_dir())})


@pytest.mark.skipif(not DATA.exists(), reason="the shared data are not there")
@pytest.mark.parametrize("path", all_bags(), ids=lambda p: str(p.relative_to(DATA)))
def test_every_bag_at_hand_gives_records_or_one_clear_line(path) -> None:
    """All that its index announces, in order; services and empty bags too."""
    files = [path] if path.is_file() else [p for p in path.iterdir() if p.suffix in {".db3", ".mcap"}]
    if not files:
        with pytest.raises(BadFile, match=r"no \.mcap or \.db3 file in this folder"):
            open_bag(path)
        return
    with open_bag(path) as bag:
        keys = [(r.log_time, r.topic) for r in bag.records()]
        assert keys == sorted(keys)
        assert len(keys) == bag.count
        assert len(bag.damage) == (0 if keys else 1)


@pytest.mark.skipif(not DATA.exists(), reason="the shared data are not there")
def test_one_recording_in_two_formats_is_one_recording() -> None:
    """tf_example exists as rosbag1 and as sqlite3."""
    one, other = read(DATA / "evo/tf_example.bag")[0], read(DATA / "evo/tf_example")[0]
    assert [(t, topic, name) for t, topic, name, _ in one] == [
        (t, topic, name) for t, topic, name, _ in other
    ]


@pytest.mark.skipif(not DATA.exists(), reason="the shared data are not there")
def test_every_message_of_a_real_rosbag1_is_understood() -> None:
    """Also those of packages that ROS 2 never had: from the definitions inside the bag."""
    with open_bag(DATA / "plotjuggler/tilt_laser.bag") as bag:
        for record in bag.records():
            bag.typestore.deserialize_cdr(record.data, record.type)
