"""Records to a bag: an .mcap file, or a rosbag2 folder with sqlite3. Equal input gives equal bytes."""

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import yaml
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, WriterError
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.rosbag2.metadata import dump_qos_v9
from rosbags.typesys import TypesysError
from rosbags.typesys.store import Typestore

from ..core.errors import BadFile
from .records import Record
from .typestore import typestore_of

_NEVER = QosTime(9223372036, 854775807)  # how ROS writes that there is no deadline
LATCHED = Qos(
    QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, _NEVER, _NEVER,
    QosLiveliness.AUTOMATIC, _NEVER, avoid_ros_namespace_conventions=False,
)  # fmt: skip


def write_bag(
    path: Path | str,
    records: Iterable[Record],
    typestore: Typestore | None = None,
    *,
    strictly_increasing: bool = False,
    chunk_bytes: int = 1 << 20,
    latched: Collection[str] = ("/tf_static",),
) -> int:
    """Write a new bag and return the number of records: `.mcap` one file, any other name a folder with sqlite3.

    typestore: definitions of the types, ROS 2 Jazzy's if not given; to copy a bag give `bag.typestore`.
    strictly_increasing: move a log time that is not later than the one before to one nanosecond after it.
    chunk_bytes: of messages in one compressed chunk of an .mcap file.
    latched: topics of which a player is to keep the last message for those who come later (transient local).
    BadFile if the path exists, cannot be written, or a type is not known. On any exception nothing is left behind.
    """
    path = Path(path)
    if path.exists():
        raise BadFile(f"{path}: exists already; remove it or choose another name")
    if path.suffix in {".bag", ".db3"}:
        raise BadFile(
            f"{path}: cannot write '{path.suffix}'; name a .mcap file, or a folder (no ending) for sqlite3"
        )
    store = typestore or typestore_of(())
    rising = _rising(records) if strictly_increasing else iter(records)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".writing-", dir=path.parent) as folder:
            unfinished = Path(folder) / path.name
            if path.suffix == ".mcap":
                count = _write_mcap(unfinished, rising, store, chunk_bytes, latched)
            else:
                count = _write_folder(unfinished, rising, store, latched)
            unfinished.rename(path)
    except (OSError, WriterError) as error:
        raise BadFile(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from None
    except (TypesysError, KeyError) as error:
        raise BadFile(f"{path}: cannot be written: a message type is not defined: {error}") from None
    return count


def _rising(records: Iterable[Record]) -> Iterator[Record]:
    last = -1
    for record in records:
        last = max(record.log_time, last + 1)
        yield record if last == record.log_time else Record(record.topic, record.type, last, record.data)


def _write_mcap(
    path: Path, records: Iterator[Record], store: Typestore, chunk_bytes: int, latched: Collection[str]
) -> int:
    schemas: dict[str, int] = {}
    channels: dict[tuple[str, str], int] = {}
    count = 0
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=chunk_bytes)
        writer.start(profile="ros2", library="slam_backend")
        for count, record in enumerate(records, start=1):
            channel = channels.get((record.topic, record.type))
            if channel is None:
                if record.type not in schemas:
                    text, _ = store.generate_msgdef(record.type, ros_version=2)
                    schemas[record.type] = writer.register_schema(record.type, "ros2msg", text.encode())
                profiles = yaml.safe_dump(dump_qos_v9([LATCHED])) if record.topic in latched else ""
                channel = writer.register_channel(
                    record.topic, "cdr", schemas[record.type], {"offered_qos_profiles": profiles}
                )
                channels[record.topic, record.type] = channel
            writer.add_message(channel, record.log_time, record.data, record.log_time, sequence=count)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it untyped
    return count


def _write_folder(path: Path, records: Iterator[Record], store: Typestore, latched: Collection[str]) -> int:
    with FolderWriter(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {}
        for record in records:
            key = record.topic, record.type
            if key not in connections:
                profiles = [LATCHED] if record.topic in latched else []
                connections[key] = writer.add_connection(*key, typestore=store, offered_qos_profiles=profiles)
            writer.write(connections[key], record.log_time, record.data)
    return sum(writer.counts.values())
